"""Page in a browser that shows pictures of the field while it trains, as often as it costs next to nothing."""

import time
from collections.abc import Callable

import torch

PICTURE_TIME = 0.05
"""Fraction of the run's time that pictures may take."""


class Live:
    """Page with the latest picture, at `address`."""

    def __init__(self) -> None:
        from ..page_server import Background, serve

        self._server, self.address = serve("mi-ntf train")
        self._background = Background(self._server)
        self._status = self._server.gui.add_markdown("The first picture comes with the first steps.")
        self._next = 0.0

    def show(self, step: int, psnr: float, picture: Callable[[], torch.Tensor]) -> None:
        """Show ``picture()`` (h, w, 3), sRGB, of `step`, if one is due; `psnr` is that of the last validation."""
        start = time.monotonic()
        if start < self._next:
            return
        image = (255 * picture()).round().to(torch.uint8).cpu().numpy()
        self._background.show(image)
        validation = "" if psnr != psnr else f", validation {psnr:.2f} dB"
        self._status.content = f"Photograph, field, normals: step {step}{validation}"
        now = time.monotonic()
        self._next = now + (now - start) / PICTURE_TIME

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
