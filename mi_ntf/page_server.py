"""Pages in a browser, served by viser (extra ``view``) to those who know their address."""

import http
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import urlsplit

from mi_ntf.core.errors import MiNtfError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

Gate: TypeAlias = "Callable[[ServerConnection, Request], Response | None]"
"""Function that answers a request, or returns None to let it pass."""


def serve(label: str, host: str = "127.0.0.1", port: int = 8080) -> tuple["viser.ViserServer", str]:
    """Serve a page called `label` at `port` or the next free one, and return the server and the page's address.

    The address ends in a random token. Requests without it are refused, and so are requests of pages of other servers,
    which a browser lets connect to this machine. Raises MiNtfError if the extra is missing, or `host` is no address of
    this machine.
    """
    try:
        import viser
    except ImportError:
        raise MiNtfError("a view needs the package viser; run pip install 'mi-ntf[view]'") from None

    class Server(viser.ViserServer):
        """Server without viser's public share link, which goes through machines of a company."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Do nothing, in place of asking for the link."""

    token = secrets.token_urlsafe(16)
    try:
        with _guarded(_gate(token)) as started:
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
    started: list[object] = []

    def guarded_serve(*args: object, process_request: Gate, **options: object) -> object:
        started.append(options)
        return serve(*args, process_request=lambda *request: gate(*request) or process_request(*request), **options)

    server.serve = guarded_serve  # type: ignore[assignment,misc]
    try:
        yield started
    finally:
        server.serve = serve  # type: ignore[misc]
