"""Headers of image files (size, alpha, Exif orientation), and pixels turned by their orientation.

Sizes and pixels are as stored. Pillow turns TIFF files, and no others, when it loads them: such TIFF files are refused.
"""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError

if TYPE_CHECKING:
    from PIL import Image

ORIENTATION, WIDTH, LENGTH = 0x0112, 256, 257  # tags of Exif and TIFF
INVERSE = (0, 1, 2, 3, 4, 5, 8, 7, 6)  # the orientation that undoes each one


class Header(NamedTuple):
    """Header of an image file."""

    orientation: int
    size: tuple[int, int]  # (width, height) in pixels
    has_alpha: bool


def open_image(path: Path, formats: tuple[str, ...] | None = None) -> "Image.Image":
    """Open an image with Pillow, whatever its size: its limit is meant for files of strangers. Raises its errors."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None
    return Image.open(path, formats=formats)


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return a view of `pixels` (H, W, ...) as stored, turned by the Exif `orientation`."""
    if orientation > 4:
        pixels = pixels.swapaxes(0, 1)
    down = -1 if orientation in (3, 4, 7, 8) else 1
    across = -1 if orientation in (2, 3, 6, 7) else 1
    return np.asarray(pixels[::down, ::across])


def read_header(path: Path) -> Header | None:
    """Return the header of the file, or None if Pillow cannot read it."""
    try:
        with open_image(path) as image:
            tags = getattr(image, "tag_v2", {}) if image.format == "TIFF" else {}
            size = (tags[WIDTH], tags[LENGTH]) if tags else image.size
            return Header(_orientation(image), size, "A" in image.getbands() or "transparency" in image.info)
    except Exception:  # reading the pixels raises the error
        return None


def check_stored(image: "Image.Image", path: Path) -> None:
    """Raise MiNtfError if Pillow or OpenCV would turn the pixels of the `image` of `path` when they load them."""
    if image.format == "TIFF" and _orientation(image) != 1:  # Pillow 13 even mixes up the rows of some
        raise MiNtfError(f"{path}: TIFF with Exif orientation {_orientation(image)} is not read; take the "
                         f"tag out with `exiftool -Orientation= {path}`, which leaves the pixels as they are stored")


def _orientation(image: "Image.Image") -> int:
    """Return the Exif orientation, 1 if there is none."""
    from PIL import Image

    if image.format == "PNG":  # `getexif` would decode the picture
        exif = Image.Exif()
        exif.load(image.info.get("exif", b""))
    else:
        exif = image.getexif()
    orientation = exif.get(ORIENTATION, 1)
    return int(orientation) if orientation in range(1, 9) else 1
