"""What a black background tells of a photograph that has no mask: a flash in a dark room lights the object alone.

Dark is not empty: shadows and black parts of the object are as dark as the room. So three things are said: what is
clearly lit is matter; what is far outside of everything lit is empty; between the two nothing is known, and training
finds out. Lengths below are shares of the photograph's longer side.
"""

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import linear, opencv

EMPTY, UNKNOWN, MATTER = 0, 128, 255
"""The alpha that says so."""
DARKEST = 0.08
"""Brightest border, of the object's brightness, that passes for black."""
NOISE, FAINT, CLEAR = 6.0, 0.005, 0.1
"""Lit begins at so many deviations of the border's noise above it, and at this share of the object's brightness;
matter at the last one: below it lies the lens's glow around bright things."""
CLOSE, AROUND = 0.05, 0.03
"""Gaps of up to twice that between lit parts, and that much around them, may be parts of the object in shadow."""
SPECK = 0.01
"""Lit parts of less than this share of the largest one's area are dust or noise."""
RIM = 0.02
"""Width of the border that is looked at."""


def alpha(stored: np.ndarray, where: str) -> np.ndarray:
    """``EMPTY``, ``UNKNOWN`` or ``MATTER`` for each pixel of a photograph (H, W, 4) as stored, (H, W) 8-bit.

    Brightness is the largest channel of the linear light, a little smoothed; the object's is its 99th percentile. The
    room's is the median of the border, and its noise their median absolute deviation: up to half of the border may show
    the object. Raises MiNtfError, with `where`, if the border is not dark.
    """
    cv2 = opencv("reading photographs before a black background")
    light = linear(stored)[..., :3].max(-1)
    longer = max(light.shape)
    smooth = max(1.0, longer / 1000)
    light = cv2.GaussianBlur(light, (0, 0), smooth)
    bright = float(np.quantile(light, 0.99))
    rim = max(1, round(RIM * longer))
    sides = light[:rim], light[-rim:], light[:, :rim], light[:, -rim:]
    border = np.concatenate([side.ravel() for side in sides])
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


def _region(lit: np.ndarray, longer: int, cv2) -> np.ndarray:
    """Where the object can be (H, W) bool: what is `lit` and larger than specks, closed, without holes, and more."""
    pieces = cv2.morphologyEx(lit.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, label, stats, _ = cv2.connectedComponentsWithStats(pieces, connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0  # the background
    kept = (area >= SPECK * area.max()) & (np.arange(count) > 0)
    reach = CLOSE * longer
    closed = ~_grown(~_grown(kept[label], reach, cv2), reach, cv2)
    outside = cv2.connectedComponents((~closed).astype(np.uint8), connectivity=4)[1]  # 0 where it is closed
    edge = np.unique(np.concatenate([outside[0], outside[-1], outside[:, 0], outside[:, -1]]))
    return _grown(~np.isin(outside, edge[edge > 0]), AROUND * longer, cv2)


def _grown(region: np.ndarray, reach: float, cv2) -> np.ndarray:
    """All pixels within `reach` of `region` (H, W) bool."""
    if not region.any():
        return region
    return cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= reach
