"""Pages in a browser that this machine alone serves (viser, the extra ``view``)."""

from mi_ntf.core.errors import MiNtfError


def serve(label: str, host: str = "127.0.0.1", port: int = 8080):
    """``(server, address)`` of a page called `label`, at `port` or the next one that is free. Raises MiNtfError where
    the extra is missing or the address is not this machine's."""
    try:
        import viser
    except ImportError:
        raise MiNtfError("a view needs the package viser; run pip install 'mi-ntf[view]'") from None

    class Server(viser.ViserServer):
        """viser offers whoever looks a public address, by way of a company's machines: not here."""

        def request_share_url(self, verbose: bool = True) -> None:
            """None, whoever asks."""

    try:
        server = Server(host=host, port=port, label=label, verbose=False)
    except OSError as error:
        raise MiNtfError(f"cannot serve at {host}:{port} ({error}); choose another --host or --port") from None
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
    server.gui.main_panel.dock_right()
    return server, f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}"
