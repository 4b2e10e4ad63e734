"""Image files as pixels over black, colour spaces explicit.

    EXR          linear; alpha premultiplied, as renderers write it; windows and layers: `exr`
    PNG, JPEG    8 bit, sRGB or what their ICC profile or gAMA says (`colour`); alpha straight (JPEG has none)
    TIFF         8 bit: as PNG; 16 bit: linear, 65535 is 1, alpha straight; floating point: as EXR
    masks        `masks`

Pillow, OpenEXR and OpenCV are imported where they are needed.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_ntf.core import files, ops, srgb
from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import colour, exif, exr

LINEAR = srgb.decode(ops, np.arange(256) / 255.0).astype(np.float32)
"""sRGB's 256 levels in linear light."""


def linear(stored: np.ndarray) -> np.ndarray:
    """Linear premultiplied RGBA (..., 4) float32 of pixels as data sets hold them (..., 4): 8-bit sRGB levels of the
    colour over black and 255 alpha, or floating-point numbers that are linear already."""
    if stored.dtype != np.uint8:
        return stored.astype(np.float32)
    return np.concatenate([LINEAR[stored[..., :3]], stored[..., 3:] / np.float32(255)], -1)


def levels(pixels: np.ndarray) -> np.ndarray:
    """The 8-bit levels (..., 4) nearest to linear premultiplied RGBA; the inverse of :func:`linear`."""
    color = srgb.encode(ops, pixels[..., :3])
    return np.round(255 * np.concatenate([color, np.clip(pixels[..., 3:], 0, 1)], -1)).astype(np.uint8)


class Decoded(NamedTuple):
    """An image as its file has it."""

    rgb: np.ndarray
    """(H, W, 3): 8-bit sRGB levels, or linear float32."""
    alpha: np.ndarray | None
    """(H, W): 8-bit, or float32."""
    straight: bool
    """The colour is not yet multiplied by alpha."""
    assumed: tuple[str, ...] = ()
    """What was assumed of the file, a clause each."""


def as_linear(image: Decoded, mask: np.ndarray | None = None) -> np.ndarray:
    """Linear premultiplied RGBA (H, W, 4) float32; alpha is `mask` (H, W) 8-bit if given, else the image's, else 1."""
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
    """The 8-bit levels of :func:`as_linear` for an 8-bit image; where alpha is 255 they are the file's."""
    pixels = np.empty((*image.rgb.shape[:2], 4), np.uint8)
    alpha = image.alpha if mask is None else mask
    pixels[..., 3] = 255 if alpha is None else alpha
    for rows in strips(pixels):
        pixels[rows][..., :3] = image.rgb[rows] if alpha is None else _dimmed()[alpha[rows][..., None], image.rgb[rows]]
    return pixels


def strips(pixels: np.ndarray) -> Iterator[slice]:
    """Rows of `pixels` (H, W, ...) by some quarter of a million pixels: a look-up takes 8 bytes for each of its own."""
    step = max(1, (1 << 18) // pixels.shape[1])
    return (slice(row, row + step) for row in range(0, len(pixels), step))


@cache
def _dimmed() -> np.ndarray:
    """[alpha, level] (256, 256): the level nearest to the light of a level times alpha."""
    light = LINEAR * (np.arange(256, dtype=np.float32) / 255)[:, None]
    return levels(np.repeat(light[..., None], 4, -1))[..., 0]


def read_image(path: Path) -> np.ndarray:
    """Linear premultiplied RGBA (H, W, 4) float32 of an image file; alpha 1 where it has none.

    Raises MiNtfError where the file is missing, unreadable, of another kind, or holds NaN or infinity.
    """
    return as_linear(decode(Path(path)))


def check_exists(path: Path) -> None:
    """Raise MiNtfError if the photograph `path` is missing."""
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; the data set is incomplete: put the file there, take its entry out, "
                         "or run the capture again (it resumes)")


def decode(path: Path) -> Decoded:
    """The image in `path`. Raises MiNtfError."""
    check_exists(path)
    reader = {".exr": _read_exr, ".png": _read_srgb, ".jpg": _read_srgb, ".jpeg": _read_srgb, ".tif": _read_tiff,
              ".tiff": _read_tiff}.get(path.suffix.lower())
    if reader is None:
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
    """8-bit image, as it is stored: what an Exif orientation turns is found by all photographs (`orientation`)."""
    from PIL import Image

    with Image.open(path) as image:
        exif.check_stored(image, path)
        if image.mode not in ("L", "LA", "P", "RGB", "RGBA"):
            raise MiNtfError(f"{path}: image of mode '{image.mode}'; write it with 8 bits a channel, or as EXR or TIFF")
        has_alpha = image.mode in ("LA", "RGBA") or "transparency" in image.info
        alpha = np.asarray(image.convert("RGBA").getchannel("A")) if has_alpha else None
        rgb, note = colour.to_srgb(image, path)
        return Decoded(np.asarray(rgb), alpha, True, (note,) if note else ())


def _read_tiff(path: Path) -> Decoded:
    """8 bits are sRGB; 16 bits, and floating point, are what a raw converter writes that is asked for linear light.

    Pillow would cut 16 bits to 8, and OpenCV multiplies 8 bits by alpha; each reads what it reads well.
    """
    bits, premultiplied, profile = _tiff_tags(path)
    if bits and max(bits) <= 8:
        return _read_srgb(path)
    if profile:
        colour.check_linear(profile, path)
    stored = opencv(f"{path}: TIFF of more than 8 bits").imread(str(path), -1)  # -1: as it is, IMREAD_UNCHANGED
    if stored is None:
        raise ValueError("OpenCV finds no image in it")
    stored = stored[..., None] if stored.ndim == 2 else stored
    whole = stored.dtype == np.uint16
    if stored.shape[2] not in (1, 3, 4) or not (whole or stored.dtype.kind == "f"):
        raise MiNtfError(f"{path}: TIFF of {stored.shape[2]} channels of {stored.dtype}; write it as RGB with 8 or 16 "
                         "bits or floating-point numbers a channel")
    stored = stored.astype(np.float32) / np.float32(65535 if whole else 1)
    rgb = stored[..., [2, 1, 0]] if stored.shape[2] > 1 else np.repeat(stored, 3, -1)
    return Decoded(rgb, stored[..., 3] if stored.shape[2] == 4 else None, whole and not premultiplied)


def _tiff_tags(path: Path) -> tuple[tuple[int, ...], bool, bytes | None]:
    """Bits of each sample, whether alpha is associated, and the ICC profile, as far as Pillow knows the file."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            tags = image.tag_v2  # type: ignore[attr-defined]  # a TIFF has them
            return tuple(tags.get(258, (1,))), 1 in tuple(tags.get(338, ())), image.info.get("icc_profile")
    except UnidentifiedImageError:
        return (), False, None


def opencv(what: str):
    """The module `cv2`, or MiNtfError: `what` needs it."""
    try:
        import cv2
    except ImportError:
        raise MiNtfError(f"{what} needs OpenCV, which is not installed: run pip install 'mi-ntf[train]'") from None
    return cv2


def size_of(path: Path) -> tuple[int, int] | None:
    """(width, height) in pixels as the head of an image file says it; None where only reading the whole would tell."""
    try:
        if path.suffix.lower() == ".exr":
            return exr.size(path)
        head = exif.head(path)
        return head and head.size
    except Exception:  # told when it is read
        return None


def write_exr(path: Path, rgba: np.ndarray) -> None:
    """Write linear premultiplied RGBA (H, W, 4) as EXR, whole or not at all: in half precision, in single where a value
    is beyond it."""
    import OpenEXR

    dtype = np.float32 if np.abs(rgba).max() > np.finfo(np.float16).max else np.float16
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGBA": np.ascontiguousarray(rgba, dtype=dtype)}) as file:
        with files.replacing(path) as temporary:
            file.write(str(temporary))
