"""Pictures for a screen."""

import numpy as np

from mi_ntf.core import ops, srgb


def bytes_of(image: np.ndarray, shown: str = "", stops: float = 0.0) -> np.ndarray:
    """(h, w, 3) of 8 bits. Light (`shown` is ""): times 2^`stops`, clipped at 1, by the sRGB curve, on black. AOVs:
    normals from −1…1, depth from the nearest (white) to the farthest (dark) that is seen, others from 0…1."""
    if shown in ("", "albedo"):
        light = np.clip(np.nan_to_num(image[..., :3]) * (2.0**stops if not shown else 1.0), 0, 1)
        return _bytes(srgb.encode(ops, light))
    if shown == "normal":
        there = (np.abs(image) > 0).any(-1, keepdims=True)
        return _bytes(np.where(there, 0.5 * image + 0.5, 0))
    value = image[..., 0]
    if shown == "depth":
        there = value > 0
        near, far = (float(value[there].min()), float(value[there].max())) if there.any() else (0.0, 1.0)
        value = np.where(there, 1 - 0.85 * (value - near) / max(far - near, 1e-9), 0)
    return _bytes(np.repeat(value[..., None], 3, -1))


def split(left: np.ndarray, right: np.ndarray, share: float) -> np.ndarray:
    """`left` up to `share` of the width, then a white line, then `right`."""
    column = round(min(max(share, 0.0), 1.0) * left.shape[1])
    picture = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < left.shape[1]:
        picture[:, column] = 255
    return picture


def _bytes(value: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(np.nan_to_num(value), 0, 1)).astype(np.uint8)
