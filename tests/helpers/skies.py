"""High-dynamic-range skies with a sun, as arrays and emitters."""

import mitsuba as mi
import numpy as np


def sky(height: int, width: int, sun=(0.3, 0.35), texels: int = 3, share: float = 0.7) -> np.ndarray:
    """(height, width, 3) float32: a smooth sky over dark ground, and a square sun of `texels` a side that gives `share`
    of all power; `sun`: its place, as shares of height and width."""
    theta = (np.arange(height) * np.pi / (height - 1))[:, None]
    phi = (np.arange(width) + 0.5)[None] * 2 * np.pi / width
    glow = 1 + 0.6 * np.cos(phi - 1) * np.sin(theta)
    image = np.where(theta < np.pi / 2, glow, 0.15 * glow)[..., None] * np.array([0.5, 0.7, 1.0])
    image = image.astype(np.float32)
    row, column = (round(s * n) for s, n in zip(sun, (height, width), strict=True))
    weight = np.sin(theta)[:, 0]
    disc = slice(row, row + texels), slice(column, column + texels)
    whole = (image.sum(-1) * weight[:, None]).sum()
    image[disc] += share / (1 - share) * whole / (3 * texels * weight[disc[0]].sum()) * np.float32([1.2, 1.0, 0.8])
    return image


def emitter(image: np.ndarray, **more) -> dict:
    """An ``envmap`` of `image`."""
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image, np.float32)), **more}
