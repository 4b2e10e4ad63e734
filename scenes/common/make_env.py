"""The scenes' environment map `env.exr`: 64x32 float32 latitude-longitude radiance, linear RGB.

Run: `python scenes/common/make_env.py`. A soft sky over a darker ground, a warm sun a few texels wide, a cool fill
on the other side; nothing in it is symmetric, so a flipped or turned lookup cannot go unseen.
Directions follow Mitsuba's `envmap`: at u = (column + 0.5) / 64 and v = (row + 0.5) / 32 the light comes from
(sin(2 pi u) sin(pi v), cos(pi v), -cos(2 pi u) sin(pi v)), y up.
"""

from pathlib import Path

import numpy as np
import OpenEXR

WIDTH, HEIGHT = 64, 32


def lobe(direction: np.ndarray, towards, sharpness: float) -> np.ndarray:
    """Spherical Gaussian exp(k (cos - 1)) around `towards`."""
    towards = np.asarray(towards, float) / np.linalg.norm(towards)
    return np.exp(sharpness * (direction @ towards - 1.0))[..., None]


def environment() -> np.ndarray:
    """Radiance (32, 64, 3), about 1 for a white diffuse surface that faces the sun."""
    u, v = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi, (np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi
    v, u = np.meshgrid(v, u, indexing="ij")
    d = np.stack([np.sin(u) * np.sin(v), np.cos(v), -np.cos(u) * np.sin(v)], -1)
    up = np.clip(0.5 + 0.5 * d[..., 1:2] * 1.6, 0, 1)
    sky = (1 - up) * np.array([0.10, 0.085, 0.07]) + up * np.array([0.22, 0.30, 0.42])
    sun = 28.0 * lobe(d, (0.75, 0.62, 0.62), 60.0) * np.array([1.0, 0.78, 0.50])
    fill = 0.9 * lobe(d, (-0.9, 0.25, 0.35), 5.0) * np.array([0.40, 0.62, 1.0])
    rim = 1.6 * lobe(d, (-0.35, 0.45, -0.85), 14.0) * np.array([1.0, 0.72, 0.80])
    return (sky + sun + fill + rim).astype(np.float32)


if __name__ == "__main__":
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": environment()}) as image:
        image.write(str(Path(__file__).with_name("env.exr")))
