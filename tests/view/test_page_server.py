"""Access to a page: only with its address, and from no other page."""

import urllib.error
import urllib.request
from urllib.parse import urlsplit

import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from mi_ntf import page_server
from mi_ntf.core.errors import MiNtfError

PROTOCOL = [f"viser-v{viser.__version__}"]


@pytest.fixture(scope="module")
def address():
    server, address = page_server.serve("test", port=8190)
    yield address
    server.stop()


def socket(address, **options):
    return connect(address.replace("http:", "ws:"), subprotocols=PROTOCOL, **options)


def test_the_page_and_its_socket_are_served_at_the_address(address):
    where = urlsplit(address)
    for place in (address, address + "/", address + "?websocket=x"):
        assert b"</html>" in urllib.request.urlopen(place).read()
    with socket(address, origin=f"http://{where.netloc}") as page:
        assert len(page.recv(timeout=20)) > 16  # what viser sends to whoever has connected
    with socket(address):  # a program that is no browser sends no origin
        pass


@pytest.mark.parametrize("origin", ["https://evil.example", "http://127.0.0.1:1", "null"])
def test_other_pages_are_refused(address, origin):
    with pytest.raises(InvalidStatus) as refused, socket(address, origin=origin):
        pass
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("path", ["", "/", "/x", "/../{token}", "/{token}x", "/?{token}"])
def test_addresses_without_the_token_are_refused(address, path):
    where = urlsplit(address)
    other = f"http://{where.netloc}{path.format(token=where.path[1:])}"
    with pytest.raises(InvalidStatus) as refused, socket(other, origin=f"http://{where.netloc}"):
        pass
    assert refused.value.response.status_code == 403
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(other)


def test_every_page_has_a_token_of_its_own(address):
    server, other = page_server.serve("another", port=8190)
    server.stop()
    assert len(urlsplit(other).path) > 20 and urlsplit(other).path != urlsplit(address).path


def test_other_servers_of_the_process_are_left_alone(address):
    server = viser.ViserServer(host="127.0.0.1", port=8195, verbose=False)
    try:
        assert b"</html>" in urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/").read()
    finally:
        server.stop()


def test_no_address_without_the_token_is_printed(capsys):
    server, _ = page_server.serve("quiet", port=8190)
    printed = capsys.readouterr().out
    server.stop()
    assert printed == ""


@pytest.mark.parametrize(("aspect", "shape"), [(2.0, (40, 80)), (0.5, (120, 60)), (1.5, (40, 60)), (1.46, (40, 60))])
def test_a_picture_of_another_shape_gets_margins(aspect, shape):
    """Deviations by the rounding of a small picture's width and height are left."""
    framed = page_server.framed(np.full((40, 60, 3), 200, np.uint8), aspect)
    assert framed.shape == (*shape, 3)
    assert framed.sum() == 40 * 60 * 3 * 200
    assert (framed[shape[0] // 2, shape[1] // 2] == 200).all()


def test_a_server_that_asks_nobody_is_not_left_running(monkeypatch):
    """A later viser might start its server in another way."""
    stopped = []
    monkeypatch.setattr(viser, "ViserServer", type("Other", (), {
        "__init__": lambda self, **options: None, "stop": lambda self: stopped.append(self)}))
    with pytest.raises(MiNtfError, match=r"viser .* starts its server in an unknown way"):
        page_server.serve("test")
    assert len(stopped) == 1
