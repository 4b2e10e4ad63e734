"""Page in a browser that shows pictures of the field while it trains, as often as it costs next to nothing."""

import time
from collections.abc import Callable

import numpy as np
import torch

PICTURE_TIME = 0.05
"""Fraction of the run's time that pictures may take."""


class Live:
    """Page with the latest picture, at `address`."""

    def __init__(self) -> None:
        from ..page_server import serve

        self._server, self.address = serve("mi-ntf train")
        self._status = self._server.gui.add_markdown("The first picture comes with the first steps.")
        self._next = 0.0

    def show(self, step: int, psnr: float, picture: Callable[[], torch.Tensor]) -> None:
        """Show ``picture()`` (h, w, 3), sRGB, of `step`, if one is due; `psnr` is that of the last validation."""
        start = time.monotonic()
        if start < self._next:
            return
        image = (255 * picture()).round().to(torch.uint8).cpu().numpy()
        height, width = image.shape[:2]
        # The page stretches a background: margins above and below keep its shape.
        framed = np.zeros((max(height, round(width / 1.4)), width, 3), np.uint8)
        top = (framed.shape[0] - height) // 2
        framed[top : top + height] = image
        self._server.scene.set_background_image(framed, format="jpeg", jpeg_quality=90)
        validation = "" if psnr != psnr else f", validation {psnr:.2f} dB"
        self._status.content = f"Photograph, field, normals: step {step}{validation}"
        now = time.monotonic()
        self._next = now + (now - start) / PICTURE_TIME

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
