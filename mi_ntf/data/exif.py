"""Headers of image files (size, alpha, Exif orientation), and pixels turned by their orientation.

Sizes and pixels are those that are stored. Pillow turns TIFF as it loads them, and no other files: they are refused.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError

TAG, WIDTH, LENGTH = 0x0112, 256, 257
"""Exif's orientation; TIFF's size."""
UNDONE = (0, 1, 2, 3, 4, 5, 8, 7, 6)
"""The orientation that undoes each one."""


class Head(NamedTuple):
    """Header of an image file."""

    orientation: int
    size: tuple[int, int]
    has_alpha: bool


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels (H, W, ...) as stored, turned as the Exif orientation says. No copy."""
    if orientation > 4:
        pixels = pixels.swapaxes(0, 1)
    down = -1 if orientation in (3, 4, 7, 8) else 1
    across = -1 if orientation in (2, 3, 6, 7) else 1
    return pixels[::down, ::across]


def head(path: Path) -> Head | None:
    """Read the header of the file; None where Pillow cannot read it."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            tags = getattr(image, "tag_v2", {}) if image.format == "TIFF" else {}
            size = (tags[WIDTH], tags[LENGTH]) if tags else image.size
            return Head(_orientation(image), size, "A" in image.getbands() or "transparency" in image.info)
    except Exception:  # reading the pixels raises the error
        return None


def check_stored(image, path: Path) -> None:
    """Raise MiNtfError where Pillow would turn the pixels of the Pillow image `image` of `path` as it loads them."""
    if image.format == "TIFF" and _orientation(image) != 1:  # Pillow 13 even mixes up the rows of some
        raise MiNtfError(f"{path}: TIFF of 8 bits with Exif orientation {_orientation(image)} is not read; take the "
                         f"tag out with `exiftool -Orientation= {path}`, which leaves the pixels as they are stored")


def _orientation(image) -> int:
    """The Exif orientation, 1 where there is none."""
    from PIL import Image

    if image.format == "PNG":  # `getexif` would decode the picture
        exif = Image.Exif()
        exif.load(image.info.get("exif", b""))
    else:
        exif = image.getexif()
    found = exif.get(TAG, 1)
    return found if found in range(1, 9) else 1
