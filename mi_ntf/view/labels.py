"""Labels on a picture: the methods on both sides of a split, and pointers to lights that are off view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from .camera import Pose
from .display import Bytes

FONT_SIZE = 12
MARGIN = 4
"""Pixels between a label and what it names, and the edge of the picture."""
TOWARDS_CENTER = {(0, -1): "lm", (0, 1): "rm", (1, -1): "ma", (1, 1): "md"}
"""Side of the picture, as axis and sign, to Pillow's anchor of a text that extends from there to the centre."""


def labelled(picture: Bytes, size: tuple[int, int], sides: tuple[str, ...], fraction: float,
             pointers: Mapping[str, NDArray[np.float64]]) -> Bytes:
    """Return `picture` with labels. If there are any, it is enlarged to `size`, so that coarse pictures have them too.

    Parameters
    ----------
    picture, size
        Bytes, and the (width, height) of the finest picture.
    sides
        Two names, of the parts on the left and right of a `fraction` of the width; any other number is not shown.
        A part that is too narrow for its name has none.
    pointers
        Names of lights that are off view, and their :func:`direction`.
    """
    if len(sides) != 2 and not pointers:
        return picture
    image = Image.fromarray(picture)
    image = image if image.size == size else image.resize(size, Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(image)
    if len(sides) == 2:
        line = fraction * size[0]
        for name, x, width, anchor in ((sides[0], line - MARGIN, line, "ra"),
                                       (sides[1], line + MARGIN, size[0] - line, "la")):
            if draw.textlength(name, ImageFont.load_default(FONT_SIZE)) + 2 * MARGIN <= width:
                _write(draw, size, name, (x, MARGIN), anchor)
    for name, towards in pointers.items():
        _point(draw, size, name, towards)
    return np.array(image)


def direction(position: ArrayLike, pose: Pose, aspect: float) -> NDArray[np.float64] | None:
    """Return the place on the edge of the picture towards a scene point, None for a point within the picture.

    The place has x to the right and y down, each from −1 to 1. `aspect` is the picture's width over its height.
    """
    x, y, z = np.linalg.inv(pose.matrix)[:3] @ np.append(np.asarray(position, np.float64), 1.0)
    place = np.array([-x / aspect, -y])  # of the camera's axes, x points left and y up
    reach = float(np.abs(place).max())
    if z > 0 and reach <= z * np.tan(np.radians(pose.fov) / 2):
        return None
    return place / reach if reach > 0 else np.array([0.0, 1.0])


def _point(draw: ImageDraw.ImageDraw, size: tuple[int, int], name: str, towards: NDArray[np.float64]) -> None:
    """Draw an arrow at the edge of the picture, and the light's name behind it."""
    axis = int(np.abs(towards).argmax())
    out = np.zeros(2)
    out[axis] = np.sign(towards[axis])
    tip = 0.5 * (towards + 1) * size
    tip[1 - axis] = np.clip(tip[1 - axis], FONT_SIZE, size[1 - axis] - FONT_SIZE)
    back, across = tip - FONT_SIZE * out, 0.5 * FONT_SIZE * out[::-1]
    draw.polygon([tuple(tip), tuple(back - across), tuple(back + across)], fill="white", outline="black")
    x, y = back - MARGIN * out
    _write(draw, size, name, (x, y), TOWARDS_CENTER[axis, int(out[axis])])


def _write(draw: ImageDraw.ImageDraw, size: tuple[int, int], text: str, place: tuple[float, float],
           anchor: str) -> None:
    """Write `text` at `place`, moved into the picture along its line."""
    font = ImageFont.load_default(FONT_SIZE)
    left, _, right, _ = draw.textbbox(place, text, font=font, anchor=anchor)
    moved = place[0] + max(0.0, MARGIN - left) - max(0.0, right - size[0] + MARGIN)
    draw.text((moved, place[1]), text, font=font, anchor=anchor, fill="white", stroke_width=2, stroke_fill="black")
