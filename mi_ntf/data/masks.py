"""Alpha of photographs: masks of the object's fraction of each pixel, or a black background in place of masks.

One rule serves mask files of every depth and colour:

    an alpha channel, not opaque throughout     is the mask (a cut-out)
    colours, 256 at most                        labels: the object is where they are not black
    grey, up to three quarters of white or more level / white is the fraction
    grey, darker, 16 levels at most             labels: the object is where they are not black (0 and 1, numbers)

White is 255, or 65535 if any level of a 16-bit file is above 255. All other files are refused.

In a dark room the flash lights the object alone. Dark does not mean empty: shadows and black parts of the object are as
dark as the room. Clearly lit pixels are matter, pixels far outside all lit ones are empty, and the pixels between are
unknown; training resolves them. Lengths of these constants are fractions of the photograph's longer side.
"""

from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import exif
from mi_ntf.data.images import linear, opencv

if TYPE_CHECKING:
    from PIL import Image

BRIGHT = 0.75  # fraction of white that the brightest level of a mask of fractions reaches
LABELS, COLOURS = 16, 256  # largest numbers of levels and of colours of a mask of labels
BLACK = 16  # noise of JPEG: channels up to this level count as black, and channels that differ by less as grey
EMPTY, UNKNOWN, MATTER = 0, 128, 255  # alpha of the three kinds of pixels
DARKEST = 0.08  # brightest border that passes for black, as a fraction of the object's brightness
NOISE, FAINT, CLEAR = 6.0, 0.005, 0.1
"""Thresholds above the border's brightness. A pixel is lit from NOISE deviations of the border's noise or FAINT of the
object's brightness on, and it is matter from CLEAR on: the lens's glow around bright things is below."""
CLOSE, AROUND = 0.05, 0.03  # shadows of the object fill gaps of 2 CLOSE between lit parts, and surround them by AROUND
SPECK = 0.01  # lit parts with less than this fraction of the largest one's area are dust or noise
RIM = 0.02  # width of the border from which the room's brightness is measured


def read(path: Path) -> tuple[np.ndarray, str | None]:
    """Return the 8-bit alpha (H, W) of the mask in `path`, and an assumption or None. Raises MiNtfError."""
    try:
        with exif.open_image(path) as image:
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


def from_background(stored: np.ndarray, where: str) -> np.ndarray:
    """Return 8-bit alpha (H, W) of a photograph (H, W, 4) as stored: ``EMPTY``, ``UNKNOWN`` or ``MATTER``.

    Brightness is the largest channel of the linear light, a little smoothed. The object's is its 99th percentile. The
    room's is the median of the border, and its noise their median absolute deviation, so up to half of the border may
    show the object. Raises MiNtfError, beginning with `where`, if the border is not dark.
    """
    cv2 = opencv("reading photographs before a black background")
    light = linear(stored)[..., :3].max(-1)
    longer = max(light.shape)
    smooth = max(1.0, longer / 1000)
    light = cv2.GaussianBlur(light, (0, 0), smooth)
    bright = float(np.quantile(light, 0.99))
    rim = max(1, round(RIM * longer))
    border = np.concatenate([side.ravel() for side in (light[:rim], light[-rim:], light[:, :rim], light[:, -rim:])])
    dark = float(np.median(border))
    if not bright > 0 or dark > DARKEST * bright:
        raise MiNtfError(f"{where}: its background is not black: the median of its border is {dark:.3g}, its brightest "
                         f"percent {bright:.3g} in linear light, and a border passes for black up to {DARKEST:.0%} of "
                         "that; darken the room, or make masks (white: object), for example with `rembg p -om images "
                         "masks`, and give their folder with --masks DIR instead of --background black")
    noise = 1.4826 * float(np.median(np.abs(border - dark)))  # standard deviation, were it Gaussian
    faint = dark + max(NOISE * noise, FAINT * bright)
    region = _region(light > faint, longer, cv2)
    matter = ~_grown(light <= max(faint, dark + CLEAR * bright), 2 * smooth, cv2)  # smoothing spread it so far
    return np.where(region & matter, MATTER, np.where(region, UNKNOWN, EMPTY)).astype(np.uint8)


def _region(lit: np.ndarray, longer: int, cv2: ModuleType) -> np.ndarray:
    """Return the mask (H, W) of possible places of the object: `lit` without specks, closed, filled and grown."""
    pieces = cv2.morphologyEx(lit.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, label, stats, _ = cv2.connectedComponentsWithStats(pieces, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0  # the background
    large = (area >= SPECK * area.max()) & (np.arange(count) > 0)
    reach = CLOSE * longer
    closed = ~_grown(~_grown(large[label], reach, cv2), reach, cv2)
    outside = cv2.connectedComponents((~closed).astype(np.uint8), connectivity=4)[1]  # 0 where it is closed
    edge = np.unique(np.concatenate([outside[0], outside[-1], outside[:, 0], outside[:, -1]]))
    return _grown(~np.isin(outside, edge[edge > 0]), AROUND * longer, cv2)


def _grown(region: np.ndarray, reach: float, cv2: ModuleType) -> np.ndarray:
    """Return the mask of all pixels within `reach` of the mask `region` (H, W)."""
    if not region.any():
        return region
    distance: np.ndarray = cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance <= reach
