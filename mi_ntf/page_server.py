"""Pages in a browser that this machine alone serves (viser, the extra ``view``), to who knows their address."""

import http
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from mi_ntf.core.errors import MiNtfError


def serve(label: str, host: str = "127.0.0.1", port: int = 8080):
    """``(server, address)`` of a page called `label`, at `port` or the next one that is free. Raises MiNtfError where
    the extra is missing or the address is not this machine's.

    The address ends in a random token. Requests without it are refused, and so are those of pages of other servers,
    which a browser lets connect to this machine.
    """
    try:
        import viser
    except ImportError:
        raise MiNtfError("a view needs the package viser; run pip install 'mi-ntf[view]'") from None

    class Server(viser.ViserServer):
        """viser offers whoever looks a public address, by way of a company's machines: not here."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Disable the public share link of viser."""

    token = secrets.token_urlsafe(16)
    try:
        with _requests_pass(_gate(token)) as guarded:
            server = Server(host=host, port=port, label=label, verbose=False)
    except OSError as error:
        raise MiNtfError(f"cannot serve at {host}:{port} ({error}); choose another --host or --port") from None
    if not guarded:
        server.stop()
        raise MiNtfError(f"viser {viser.__version__} starts its server in an unknown way, which would answer any page "
                         "of the browser; run pip install 'viser==1.1.1'")
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    server.gui.main_panel.dock_right()
    return server, f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}/{token}"


def _gate(token: str) -> Callable[[Any, Any], Any]:
    """Return a function ``(connection, request)`` that answers requests without `token` or of a foreign origin.

    It returns their refusal. For all others it returns None and removes the token, the first part of their path."""

    def refuse(connection: Any, request: Any) -> Any:
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
def _requests_pass(refuse: Callable[[Any, Any], Any]) -> Iterator[list]:
    """Let `refuse` see each request to servers that the package websockets starts within the context.

    The context's value is a list with an entry for each such server. viser has no option for this purpose."""
    from websockets.asyncio import server

    serve: Any = server.serve
    started: list = []

    def guarded(*args: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        started.append(options)
        return serve(*args, process_request=lambda *request: refuse(*request) or process_request(*request), **options)

    server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield started
    finally:
        server.serve = serve  # type: ignore[misc]
