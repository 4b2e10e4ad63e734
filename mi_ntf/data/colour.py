"""Colour spaces of 8-bit files: levels become sRGB's by the ICC profile, or by PNG's `gAMA`, that the file has.

Source: PNG specification, 3rd edition, section 12 on the precedence of iCCP, sRGB and gAMA; the profiles' arithmetic is
Little CMS's, in Pillow (relative colorimetric).
"""

import io
from functools import lru_cache
from pathlib import Path

import numpy as np

from mi_ntf.core import ops, srgb
from mi_ntf.core.errors import MiNtfError, shown

SAME = 2
"""Levels that a colour may differ from sRGB's, and linear light from that of Rec. 709, to count as the same."""
SRGB_GAMMA = 1 / 2.2
"""`gAMA` of files in sRGB, as the specification has it."""
PRIMARIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
"""x and y of red, green and blue of Rec. 709, which sRGB has."""


def to_srgb(image, path: Path):
    """``(image, what was assumed or None)``: the Pillow image `image` of `path` as RGB of sRGB. Raises MiNtfError."""
    profile = image.info.get("icc_profile")
    if profile:
        grey = image.mode in ("L", "LA", "1")
        transform, title, same = _transform(profile, grey, path)
        if same:
            return image.convert("RGB"), None
        from PIL import ImageCms

        source = image.convert("L" if transform.input_mode == "L" else "RGB")
        return ImageCms.applyTransform(source, transform), f"colours are converted from the ICC profile {title} to sRGB"
    rgb = image.convert("RGB")
    if image.format != "PNG" or "srgb" in image.info:
        return rgb, None
    found = image.info.get("chromaticity")
    if found is not None and np.abs(np.array(found[2:8]) - PRIMARIES).max() > 0.01:
        raise MiNtfError(f"{path}: its chunk cHRM says primaries {shown(list(found[2:8]))}, others than sRGB's; "
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
    transform, title, _ = _transform(profile, False, path)
    found = np.asarray(ImageCms.applyTransform(lattice, transform), np.int32)
    expected = np.round(255 * srgb.encode(ops, np.asarray(lattice) / 255.0))
    if np.abs(found - expected).max() > SAME:
        raise MiNtfError(f"{path}: its ICC profile is {title}; TIFF of more than 8 bits is read as linear light in "
                         "Rec. 709: export it with a linear sRGB (Rec. 709) profile, or with 8 bits")


def _lattice(step: int):
    """An image of colours that spread over the cube."""
    from PIL import Image

    axis = np.array([*range(0, 255, step), 255], np.uint8)
    colours = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return Image.fromarray(np.ascontiguousarray(colours.reshape(len(axis), -1, 3)))


def _transform(profile: bytes, grey: bool, path: Path):
    """Return ``(transform to sRGB, the profile's name, True if it changes nothing)``; `grey`: the image is grey."""
    from PIL import ImageCms

    try:
        return _built(profile, grey)
    except (ImageCms.PyCMSError, OSError) as error:
        raise MiNtfError(f"{path}: its ICC profile cannot be used ({shown(str(error).strip())}); convert it to sRGB, "
                         "or take the profile out with `exiftool -icc_profile= FILE` if it is sRGB already") from None


@lru_cache(maxsize=8)
def _built(profile: bytes, grey: bool):
    from PIL import ImageCms

    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    title = shown(ImageCms.getProfileDescription(opened).strip())
    mode = "L" if grey and opened.profile.xcolor_space.strip() == "GRAY" else "RGB"
    transform = ImageCms.buildTransform(opened, ImageCms.createProfile("sRGB"), mode, "RGB",
                                        ImageCms.Intent.RELATIVE_COLORIMETRIC)
    probe = _lattice(16).convert("L" if mode == "L" else "RGB")
    changed = np.asarray(ImageCms.applyTransform(probe, transform), np.int32) - np.asarray(probe.convert("RGB"))
    return transform, title, bool(np.abs(changed).max() <= SAME)
