"""Alpha of a photograph without a mask before a black background: in a dark room the flash lights the object alone.

Dark does not mean empty: shadows and black parts of the object are as dark as the room. Clearly lit pixels are matter,
pixels far outside all lit ones are empty, and the pixels between are unknown; training resolves them. Lengths below are
fractions of the photograph's longer side.
"""

from types import ModuleType

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import linear, opencv

EMPTY, UNKNOWN, MATTER = 0, 128, 255  # alpha of the three kinds of pixels
DARKEST = 0.08  # brightest border that passes for black, as a fraction of the object's brightness
NOISE, FAINT, CLEAR = 6.0, 0.005, 0.1
"""Thresholds above the border's brightness. A pixel is lit from NOISE deviations of the border's noise or FAINT of the
object's brightness on, and it is matter from CLEAR on: the lens's glow around bright things is below."""
CLOSE, AROUND = 0.05, 0.03  # shadows of the object fill gaps of 2 CLOSE between lit parts, and surround them by AROUND
SPECK = 0.01  # lit parts with less than this fraction of the largest one's area are dust or noise
RIM = 0.02  # width of the border from which the room's brightness is measured


def alpha(stored: np.ndarray, where: str) -> np.ndarray:
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
