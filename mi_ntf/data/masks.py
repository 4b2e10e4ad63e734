"""Masks: images of the object's fraction of each pixel. One rule serves files of every depth and colour.

    an alpha channel, not opaque throughout     is the mask (a cut-out)
    colours, 256 at most                        labels: the object is where they are not black
    grey, up to three quarters of white or more level / white is the fraction
    grey, darker, 16 levels at most             labels: the object is where they are not black (0 and 1, numbers)

White is 255, or 65535 if any level of a 16-bit file is above 255. All other files are refused.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import exif

if TYPE_CHECKING:
    from PIL import Image

BRIGHT = 0.75  # fraction of white that the brightest level of a mask of fractions reaches
LABELS, COLOURS = 16, 256  # largest numbers of levels and of colours of a mask of labels
BLACK = 16  # noise of JPEG: channels up to this level count as black, and channels that differ by less as grey


def read(path: Path) -> tuple[np.ndarray, str | None]:
    """Return the 8-bit alpha (H, W) of the mask in `path`, and an assumption or None. Raises MiNtfError."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            exif.check_stored(image, path)
            return _decode(image, path)
    except MiNtfError:
        raise
    except Exception as error:
        raise MiNtfError(f"{path}: cannot be read as a mask ({shown(str(error))}); write it as 8-bit grey PNG"
                         ) from error


def _decode(image: "Image.Image", path: Path) -> tuple[np.ndarray, str | None]:
    if image.mode[:1] == "F":
        raise ValueError(f"mode '{image.mode}'")
    if image.mode[:1] == "I":
        levels = np.asarray(image)
        return _grey(levels, 65535 if levels.max(initial=0) > 255 else 255, path)
    if "A" in image.getbands() or "transparency" in image.info:
        image = image.convert("RGBA")
        alpha = np.asarray(image.getchannel("A"))
        if alpha.min() < 255:
            return alpha, "a mask that has an alpha channel is that channel"
    if image.mode not in ("1", "L"):
        image = image.convert("RGB")
        pixels = np.asarray(image)
        if any(np.abs(pixels[..., 0].astype(np.int16) - pixels[..., k]).max(initial=0) > BLACK for k in (1, 2)):
            return _coloured(image, pixels, path)
    return _grey(np.asarray(image.convert("L")), 255, path)


def _coloured(image: "Image.Image", pixels: np.ndarray, path: Path) -> tuple[np.ndarray, str]:
    """Return the alpha of a coloured mask of labels: 0 or 255."""
    shows = pixels.max(-1) > BLACK
    if image.getcolors(COLOURS) is None or shows.all():
        fault = "nothing in it is black" if shows.all() else f"it has more than {COLOURS} colours"
        raise MiNtfError(f"{path}: is coloured, and {fault}, so it is no mask of labels on black; write the object "
                         "white and everything else black, as 8-bit grey PNG")
    return np.where(shows, np.uint8(255), np.uint8(0)), "a coloured mask shows the object where it is not black"


def _grey(levels: np.ndarray, white: int, path: Path) -> tuple[np.ndarray, str | None]:
    """Return the alpha of grey `levels` (H, W), which are fractions of `white` or labels."""
    used = np.flatnonzero(np.bincount(levels.ravel(), minlength=2))  # raises for negative ones
    brightest = int(used.max(initial=0))
    if brightest >= BRIGHT * white or (len(used) == 1 and brightest != 1):  # one level alone is a fraction
        return np.round(levels * (255 / white)).astype(np.uint8) if levels.dtype != np.uint8 else levels, None
    if len(used) <= LABELS:
        return np.where(levels > 0, np.uint8(255), np.uint8(0)), (
            "a mask of few dark levels shows the object where it is not black")
    raise MiNtfError(f"{path}: its brightest level is {brightest} of {white}, and it has {len(used)} levels, so "
                     "neither is white the object nor are they labels; write the object white and everything else "
                     "black, as 8-bit grey PNG")
