"""Pages in a browser, served by viser (extra ``view``) to those who know their address."""

import asyncio
import http
import io
import itertools
import logging
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from mi_ntf.core import extras
from mi_ntf.core.errors import MiNtfError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

Gate: TypeAlias = "Callable[[ServerConnection, Request], Response | None]"
"""Function that answers a request, or returns None to let it pass."""
Pixels: TypeAlias = NDArray[np.uint8]
JPEG_QUALITY = 90
ASK = 1.0
"""Seconds between two questions for the size of a window."""
NUDGE = 1e-4
"""Relative change of the field of view that a browser answers. On 1000 pixels, it moves none by more than 0.05."""


def serve(label: str, host: str = "127.0.0.1", port: int = 8080) -> tuple["viser.ViserServer", str]:
    """Serve a page called `label` at `port` or the next free one, and return the server and the page's address.

    The address ends in a random token. Requests without it are refused, and so are requests of pages of other servers,
    which a browser lets connect to this machine. Raises MiNtfError if the extra is missing, or `host` is no address of
    this machine.
    """
    extras.need("view", "a view")
    import viser

    class Server(viser.ViserServer):
        """Server without viser's public share link, which goes through machines of a company."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Do nothing, in place of asking for the link."""

    token = secrets.token_urlsafe(16)
    try:
        # viser prints an address without the token, which would be refused.
        with _guarded(_gate(token)) as started, redirect_stdout(io.StringIO()):
            server = Server(host=host, port=port, label=label, verbose=False)
    except OSError as error:
        raise MiNtfError(f"cannot serve at {host}:{port} ({error}); choose another --host or --port") from None
    if not started:
        server.stop()
        raise MiNtfError(f"viser {viser.__version__} starts its server in an unknown way, which would answer any page "
                         "of the browser; run pip install 'viser==1.1.1'")
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    server.gui.main_panel.dock_right()
    return server, f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}/{token}"


class Background:
    """Picture behind the scene of a page, with margins that give it the shape of each browser's window.

    viser stretches a picture to the window. It does not always tell when the window's size has changed, above all while
    a page is opened, so that the browser is asked again and again.
    """

    def __init__(self, server: "viser.ViserServer") -> None:
        self._server = server
        self._picture: Pixels | None = None
        server.on_client_connect(self._follow)

    def show(self, picture: Pixels) -> None:
        """Show `picture` (h, w, 3) in all windows, and in those that are opened or resized later."""
        self._picture = picture
        for client in self._server.get_clients().values():
            self._send(client)

    async def _follow(self, client: "viser.ClientHandle") -> None:
        """Send the picture to a new window, and again whenever the window gets another shape."""
        aspect = 0.0

        async def update(camera: "viser.CameraHandle") -> None:
            nonlocal aspect
            if camera.aspect != aspect:
                aspect = camera.aspect
                self._send(client)

        client.camera.on_update(update)
        await update(client.camera)
        loop, factors = asyncio.get_running_loop(), itertools.cycle((1 + NUDGE, 1 / (1 + NUDGE)))

        def ask() -> None:
            if client.client_id in self._server.get_clients():
                client.camera.fov *= next(factors)  # the browser answers with its camera and its window
                loop.call_later(ASK, ask)

        loop.call_later(ASK, ask)

    def _send(self, client: "viser.ClientHandle") -> None:
        if self._picture is not None:
            client.scene.set_background_image(framed(self._picture, client.camera.aspect), format="jpeg",
                                              jpeg_quality=JPEG_QUALITY)


def framed(picture: Pixels, aspect: float) -> Pixels:
    """Return `picture` between black margins, `aspect` times as wide as high."""
    height, width = picture.shape[:2]
    across, down = round(aspect * height) - width, round(width / aspect) - height
    if max(across, down) <= 2:  # the picture has this shape but for the rounding of its own width and height
        return picture
    margins = [(max(n, 0) // 2, max(n, 0) - max(n, 0) // 2) for n in (down, across)]
    return np.pad(picture, (*margins, (0, 0)))


def _gate(token: str) -> Gate:
    """Return the gate that refuses requests without `token`, or of a foreign origin.

    For all others it removes the token, the first part of the request's path.
    """

    def refuse(connection: "ServerConnection", request: "Request") -> "Response | None":
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.headers.get("Host"):
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"Pages of {origin} may not connect to this one.\n")
        first, _, rest = request.path.removeprefix("/").partition("?")[0].partition("/")
        if not secrets.compare_digest(first.encode(), token.encode()):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Open the address that the command printed.\n")
        request.path = "/" + rest
        return None

    return refuse


@contextmanager
def _guarded(gate: Gate) -> Iterator[list[object]]:
    """Put `gate` before each server that the package websockets starts within the context.

    The context's value is a list with an entry for each such server. viser has no option for this purpose.
    """
    from websockets.asyncio import server

    serve: Any = server.serve
    quiet = logging.getLogger(__name__)
    quiet.setLevel(logging.CRITICAL)  # browsers open connections that they close unused, which are no errors
    started: list[object] = []

    def guarded_serve(*args: object, process_request: Gate, **options: object) -> object:
        started.append(options)
        return serve(*args, process_request=lambda *request: gate(*request) or process_request(*request), logger=quiet,
                     **options)

    server.serve = guarded_serve  # type: ignore[assignment,misc]
    try:
        yield started
    finally:
        server.serve = serve  # type: ignore[misc]
