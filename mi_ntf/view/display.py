"""Conversion of rendered images to bytes for a screen."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mi_ntf.core import ops, srgb

Bytes: TypeAlias = NDArray[np.uint8]


def bytes_of(image: np.ndarray, aov: str = "", stops: float = 0.0) -> Bytes:
    """Return the picture of an image, (h, w, 3) of 8 bits.

    Light (`aov` is "") is multiplied by 2^`stops`, clipped at 1 and encoded by the sRGB curve. Normals are mapped from
    [-1, 1], other outputs from [0, 1]. Depth goes from white at the nearest visible point to dark at the farthest.
    """
    if aov in ("", "albedo"):
        light = np.clip(np.nan_to_num(image[..., :3]) * (1.0 if aov else 2.0**stops), 0, 1)
        return _quantised(srgb.encode(ops, light))
    if aov == "normal":
        is_hit = (np.abs(image) > 0).any(-1, keepdims=True)
        return _quantised(np.where(is_hit, 0.5 * image + 0.5, 0))
    value = image[..., 0]
    if aov == "depth":
        is_hit = value > 0
        near, far = (float(value[is_hit].min()), float(value[is_hit].max())) if is_hit.any() else (0.0, 1.0)
        value = np.where(is_hit, 1 - 0.85 * (value - near) / max(far - near, 1e-9), 0)
    return _quantised(np.repeat(value[..., None], 3, -1))


def split(left: Bytes, right: Bytes, fraction: float) -> Bytes:
    """Return `left` up to `fraction` of the width, then a white line, then `right`."""
    column = round(min(max(fraction, 0.0), 1.0) * left.shape[1])
    picture = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < left.shape[1]:
        picture[:, column] = 255
    return picture


def _quantised(value: np.ndarray) -> Bytes:
    return np.asarray(np.round(255 * np.clip(np.nan_to_num(value), 0, 1)), np.uint8)
