"""Colour spaces of 8-bit files: levels become those of sRGB by the file's ICC profile, or by PNG's `gAMA`.

Source: PNG specification, 3rd edition, section 12, for the precedence of iCCP, sRGB and gAMA. Little CMS, in Pillow,
applies the profiles (relative colorimetric).
"""

import io
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mi_ntf.core import ops, srgb
from mi_ntf.core.errors import MiNtfError, shown

if TYPE_CHECKING:
    from PIL import Image, ImageCms

TOLERANCE = 2  # levels by which colours may differ for a profile to count as sRGB or as linear Rec. 709
INTEROPERABILITY = 0xA005  # directory of Exif
SRGB_GAMMA = 1 / 2.2  # `gAMA` of files in sRGB, by the specification
PRIMARIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06)  # x and y of red, green and blue of Rec. 709 and sRGB


class Conversion(NamedTuple):
    """Conversion from the space of an ICC profile to sRGB."""

    transform: "ImageCms.ImageCmsTransform"
    title: str
    changes: bool  # True if the conversion changes colours by more than ``TOLERANCE`` levels


def to_srgb(image: "Image.Image", path: Path) -> "tuple[Image.Image, str | None]":
    """Return the `image` of `path` as RGB of sRGB, and an assumption or None. Raises MiNtfError."""
    profile = image.info.get("icc_profile")
    if profile:
        conversion = _conversion(profile, image.mode in ("L", "LA", "1"), path)
        if not conversion.changes:
            return image.convert("RGB"), None
        from PIL import ImageCms

        source = image.convert("L" if conversion.transform.input_mode == "L" else "RGB")
        converted = ImageCms.applyTransform(source, conversion.transform)
        assert converted is not None  # it is None for transforms in place
        return converted, f"colours are converted from the ICC profile {conversion.title} to sRGB"
    rgb = image.convert("RGB")
    if image.getexif().get_ifd(INTEROPERABILITY).get(1) == "R03":  # cameras write no profile
        raise MiNtfError(f"{path}: its Exif tags say Adobe RGB, and it has no ICC profile; convert it to sRGB, or "
                         "develop it anew as sRGB")
    if image.format != "PNG" or "srgb" in image.info:
        return rgb, None
    chromaticity = image.info.get("chromaticity")
    if chromaticity is not None and np.abs(np.array(chromaticity[2:8]) - PRIMARIES).max() > 0.01:
        raise MiNtfError(f"{path}: its chunk cHRM says primaries {shown(list(chromaticity[2:8]))}, others than sRGB's; "
                         "convert it to sRGB")
    gamma = image.info.get("gamma", SRGB_GAMMA)
    if not 0.01 < gamma < 100 or abs(gamma / SRGB_GAMMA - 1) < 0.05:  # zero has no meaning
        return rgb, None
    levels = np.round(255 * srgb.encode(ops, (np.arange(256) / 255) ** (1 / gamma))).astype(int).tolist()
    return rgb.point(3 * levels), f"levels are converted from gAMA {gamma:.4g} to sRGB"


def check_linear(profile: bytes, path: Path) -> None:
    """Raise MiNtfError unless the ICC `profile` is that of linear light with the primaries of Rec. 709."""
    from PIL import ImageCms

    lattice = _lattice(16)
    conversion = _conversion(profile, False, path)
    levels = np.asarray(ImageCms.applyTransform(lattice, conversion.transform), np.int32)
    expected = np.round(255 * srgb.encode(ops, np.asarray(lattice) / 255.0))
    if np.abs(levels - expected).max() > TOLERANCE:
        raise MiNtfError(f"{path}: its ICC profile is {conversion.title}; TIFF of more than 8 bits is read as linear "
                         "light in Rec. 709: export it with a linear sRGB (Rec. 709) profile, or with 8 bits")


def _lattice(step: int) -> "Image.Image":
    from PIL import Image

    axis = np.array([*range(0, 255, step), 255], np.uint8)
    colours = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return Image.fromarray(np.ascontiguousarray(colours.reshape(len(axis), -1, 3)))


def _conversion(profile: bytes, grey: bool, path: Path) -> Conversion:
    """Return the conversion of `profile`; `grey` says that the image is grey. Raises MiNtfError."""
    from PIL import ImageCms

    try:
        return _build(profile, grey)
    except (ImageCms.PyCMSError, OSError) as error:
        raise MiNtfError(f"{path}: its ICC profile cannot be used ({shown(str(error).strip())}); convert it to sRGB, "
                         "or take the profile out with `exiftool -icc_profile= FILE` if it is sRGB already") from None


@lru_cache(maxsize=8)
def _build(profile: bytes, grey: bool) -> Conversion:
    from PIL import ImageCms

    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    title = shown(ImageCms.getProfileDescription(opened).strip())
    mode = "L" if grey and opened.profile.xcolor_space.strip() == "GRAY" else "RGB"
    transform = ImageCms.buildTransform(opened, ImageCms.createProfile("sRGB"), mode, "RGB",
                                        ImageCms.Intent.RELATIVE_COLORIMETRIC)
    probe = _lattice(16).convert(mode)
    change = np.asarray(ImageCms.applyTransform(probe, transform), np.int32) - np.asarray(probe.convert("RGB"))
    return Conversion(transform, title, bool(np.abs(change).max() > TOLERANCE))
