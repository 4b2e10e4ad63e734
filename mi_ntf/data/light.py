"""The flash's radiant intensity, where nobody measured it."""

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import linear

ALBEDO = 0.8
"""What the brightest surface is taken to reflect."""
SAMPLES = 1 << 22
"""Pixels that are looked at, of all photographs together."""


def estimate(images: np.ndarray, light_pos: np.ndarray, center: np.ndarray, radius: float) -> float:
    """Radiant intensity of a white flash, the same in all frames, that gives the object a sensible albedo.

    Photographs determine intensity × albedo alone. A Lambert surface at distance d that faces the flash has radiance
    L = albedo/π · I/d², so π L d²/I is the albedo, times a cosine. I is such that the 95th percentile of the lit pixels
    has ``ALBEDO`` in its largest channel. d is the flash's distance to the sphere's centre less half its radius, the
    middle of what is seen. Lit: covered, and above a hundredth of the brightest percent.

    images (N, H, W, 4) as stored · light_pos (N, 3) and `center`, `radius` world units.
    """
    pixels = images.shape[1] * images.shape[2]
    step = max(1, pixels // 65536, len(images) * pixels // SAMPLES)  # so many decide it as well as all
    distance = np.linalg.norm(light_pos - center, axis=1) - 0.5 * radius
    value = np.concatenate([np.pi * _covered(image, step) * d**2 for image, d in zip(images, distance, strict=True)])
    value = value[value > 0.01 * np.quantile(value, 0.99)] if len(value) else value
    if not len(value):
        raise MiNtfError(f"none of the {len(images)} photographs for training shows anything lit, so the flash's "
                         "intensity cannot be estimated; check the images and their masks (white: object)")
    return float(np.quantile(value, 0.95)) / ALBEDO


def _covered(image: np.ndarray, step: int) -> np.ndarray:
    """The largest channel, linear, of every `step`-th pixel of `image` (H, W, 4) as stored that the object fills."""
    pixels = linear(image.reshape(-1, 4)[::step])
    return pixels[pixels[:, 3] > 0.99, :3].max(-1)
