"""Image files as pixels over black, with explicit colour spaces.

    EXR          linear; alpha premultiplied, as renderers write it; windows and layers: `exr`
    PNG, JPEG    8 bit, sRGB or the space of their ICC profile or gAMA (`colour`); alpha straight (JPEG has none);
                 WebP and BMP likewise
    TIFF         8 bit: as PNG; 16 bit: linear, 65535 is 1, alpha straight; floating point: as EXR
    masks        `masks`

Pillow, OpenEXR and OpenCV are imported where they are needed.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from mi_ntf.core import extras, ops, srgb
from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import colour, exif, exr
from mi_ntf.data.file_names import SUFFIXES, TIFF_SUFFIXES

LINEAR = srgb.decode(ops, np.arange(256) / 255.0).astype(np.float32)  # sRGB's 256 levels in linear light


def linear(stored: np.ndarray) -> np.ndarray:
    """Return linear premultiplied RGBA (..., 4) float32 of pixels as data sets hold them (..., 4).

    Stored pixels are 8-bit sRGB levels of the colour over black with 255 times alpha, or linear floating-point numbers.
    """
    if stored.dtype != np.uint8:
        return stored.astype(np.float32)
    return np.concatenate([LINEAR[stored[..., :3]], stored[..., 3:] / np.float32(255)], -1)


def levels(pixels: np.ndarray) -> np.ndarray:
    """Return the 8-bit levels (..., 4) nearest to linear premultiplied RGBA: the inverse of :func:`linear`."""
    color = srgb.encode(ops, pixels[..., :3])
    return np.round(255 * np.concatenate([color, np.clip(pixels[..., 3:], 0, 1)], -1)).astype(np.uint8)


class Decoded(NamedTuple):
    """Content of an image file."""

    rgb: np.ndarray  # (H, W, 3): 8-bit sRGB levels, or linear float32
    alpha: np.ndarray | None  # (H, W): 8-bit, or float32
    straight: bool  # True if the colour is not yet multiplied by alpha
    assumed: tuple[str, ...] = ()  # assumptions about the file, a clause each


def as_linear(image: Decoded, mask: np.ndarray | None = None) -> np.ndarray:
    """Return linear premultiplied RGBA (H, W, 4) float32; alpha is the 8-bit `mask` (H, W), or the image's, or 1."""
    pixels = np.empty((*image.rgb.shape[:2], 4), np.float32)
    alpha = image.alpha if mask is None else mask
    for rows in strips(pixels):
        part, rgb = pixels[rows], image.rgb[rows]
        part[..., :3] = LINEAR[rgb] if rgb.dtype == np.uint8 else rgb
        part[..., 3] = 1 if alpha is None else alpha[rows] / np.float32(255 if alpha.dtype == np.uint8 else 1)
        if mask is not None or image.straight:
            part[..., :3] *= part[..., 3:]
    return pixels


def as_levels(image: Decoded, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the 8-bit levels of :func:`as_linear` for an 8-bit image; opaque pixels keep the file's levels."""
    pixels = np.empty((*image.rgb.shape[:2], 4), np.uint8)
    alpha = image.alpha if mask is None else mask
    pixels[..., 3] = 255 if alpha is None else alpha
    for rows in strips(pixels):
        pixels[rows][..., :3] = image.rgb[rows] if alpha is None else _dimmed()[alpha[rows][..., None], image.rgb[rows]]
    return pixels


def strips(pixels: np.ndarray) -> Iterator[slice]:
    """Return slices of rows of `pixels` (H, W, ...), each of about 2^18 pixels, to bound the memory of look-ups."""
    step = max(1, (1 << 18) // pixels.shape[1])
    return (slice(row, row + step) for row in range(0, len(pixels), step))


@cache
def _dimmed() -> np.ndarray:
    """Return the table [alpha, level] (256, 256) of the level nearest to the light of a level times alpha."""
    light = LINEAR * (np.arange(256, dtype=np.float32) / 255)[:, None]
    return levels(np.repeat(light[..., None], 4, -1))[..., 0]


def read_image(path: Path) -> np.ndarray:
    """Return linear premultiplied RGBA (H, W, 4) float32 of an image file; alpha is 1 if it has none.

    Raises MiNtfError if the file is missing, unreadable, of another kind, or holds NaN or infinity.
    """
    return as_linear(decode(Path(path)))


def check_exists(path: Path) -> None:
    """Raise MiNtfError if the photograph `path` is missing."""
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; the data set is incomplete: put the file there, take its entry out, "
                         "or run the capture again (it resumes)")


def decode(path: Path) -> Decoded:
    """Return the image in `path`. Raises MiNtfError."""
    check_exists(path)
    suffix = path.suffix.lower()
    reader = _read_exr if suffix == ".exr" else _read_tiff if suffix in TIFF_SUFFIXES else _read_srgb
    if suffix not in SUFFIXES:
        raise MiNtfError(f"{path}: images of type '{path.suffix}' are not read; convert it to .exr, .tif, .png or .jpg")
    try:
        image = reader(path)
    except MiNtfError:
        raise
    except Exception as error:  # OpenEXR, Pillow and OpenCV raise many kinds for a damaged file
        raise MiNtfError(f"{path}: cannot be read as an image ({shown(str(error))}); delete it and capture or copy it "
                         "again") from error
    bad = 0 if image.rgb.dtype == np.uint8 else sum(_count_bad(image, rows) for rows in strips(image.rgb))
    if bad:
        raise MiNtfError(f"{path}: {bad} pixels are NaN or infinite (half precision ends at 65504); write it with 32 "
                         "bits a channel or under a weaker light. One of `mi-ntf capture` can be deleted: the same "
                         "command makes it anew")
    return image


def _count_bad(image: Decoded, rows: slice) -> int:
    finite = np.isfinite(image.rgb[rows]).all(-1)
    return int(np.count_nonzero(~(finite if image.alpha is None else finite & np.isfinite(image.alpha[rows]))))


def _read_exr(path: Path) -> Decoded:
    rgb, alpha, assumed = exr.read(path)
    return Decoded(rgb, alpha, False, tuple(assumed))


def _read_srgb(path: Path) -> Decoded:
    """Read an 8-bit image as it is stored, not turned by its Exif orientation."""
    with exif.open_image(path) as image:
        exif.check_stored(image, path)
        if image.mode not in ("L", "LA", "P", "RGB", "RGBA"):
            raise MiNtfError(f"{path}: image of mode '{image.mode}'; write it with 8 bits a channel, or as EXR or TIFF")
        has_alpha = image.mode in ("LA", "RGBA") or "transparency" in image.info
        alpha = np.asarray(image.convert("RGBA").getchannel("A")) if has_alpha else None
        rgb, note = colour.to_srgb(image, path)
        return Decoded(np.asarray(rgb), alpha, True, (note,) if note else ())


def _read_tiff(path: Path) -> Decoded:
    """Read a TIFF file: 8 bits are sRGB; 16 bits and floating point are linear, as raw converters write them.

    Pillow would cut 16 bits to 8, and OpenCV multiplies 8 bits by alpha, so each depth has its own library.
    """
    from PIL import UnidentifiedImageError

    bits: tuple[int, ...] = ()
    premultiplied, profile = False, None
    try:
        with exif.open_image(path, ("TIFF",)) as image:
            exif.check_stored(image, path)
            tags = getattr(image, "tag_v2", {})
            bits, premultiplied = tags.get(258, (1,)), 1 in tags.get(338, ())  # BitsPerSample, ExtraSamples
            profile = image.info.get("icc_profile")
    except UnidentifiedImageError:
        pass
    if bits and max(bits) <= 8:
        return _read_srgb(path)
    if profile:
        colour.check_linear(profile, path)
    stored = opencv(f"{path}: TIFF of more than 8 bits").imread(str(path), -1)  # IMREAD_UNCHANGED
    if stored is None:
        raise ValueError("OpenCV finds no image in it")
    stored = stored[..., None] if stored.ndim == 2 else stored
    whole = stored.dtype == np.uint16
    if stored.shape[2] not in (1, 3, 4) or not (whole or stored.dtype.kind == "f"):
        raise MiNtfError(f"{path}: TIFF of {stored.shape[2]} channels of {stored.dtype}; write it as RGB with 8 or 16 "
                         "bits or floating-point numbers a channel")
    stored = stored.astype(np.float32) / np.float32(65535 if whole else 1)
    rgb = stored[..., [2, 1, 0]] if stored.shape[2] > 1 else np.repeat(stored, 3, -1)
    assumed = ("a TIFF file of 16 bits without a colour profile holds linear light",) if whole and not profile else ()
    return Decoded(rgb, stored[..., 3] if stored.shape[2] == 4 else None, whole and not premultiplied, assumed)


def opencv(purpose: str) -> ModuleType:
    """Return the module `cv2`. Raises the MiNtfError that `purpose` needs it if it is not installed."""
    extras.need("train", purpose, "cv2")
    import cv2

    return cv2


def size_of(path: Path) -> tuple[int, int] | None:
    """Return (width, height) in pixels from an image file's header, or None if the header does not tell."""
    try:
        if path.suffix.lower() == ".exr":
            return exr.size(path)
        header = exif.read_header(path)
        return header and header.size
    except Exception:  # reading the pixels raises the error
        return None
