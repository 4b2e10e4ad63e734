"""Volumes of `cloud`: a semi-transparent cloud, fractal noise under a radial envelope, warm below and blue above.

Run: `python scenes/cloud/make_cloud.py`. Deterministic; writes `volumes/density.vol` (extinction, 1/scene unit) and
`volumes/albedo.vol` (linear RGB) into the cube around the bounding sphere of `mesh.xml`, which maps [0, 1]³ onto it.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

RADIUS = 0.9        # of the bounding sphere in scene units, as in mesh.xml
CELLS, COLOURS = 64, 16  # texels along an edge of the density and of the albedo
OPTICAL_DEPTH = 5.0  # of the densest line parallel to an axis: e^-5 = 0.7 % of the light comes through


def centres(count: int) -> np.ndarray:
    """Texel centres (count, count, count, 3) of [-1, 1]³, z y x order as .vol files have it, last axis x y z."""
    axis = (np.arange(count) + 0.5) * (2 / count) - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.stack([x, y, z], -1)


def fractal_noise(p: np.ndarray, frequency: float, octaves: int, rng: np.random.Generator) -> np.ndarray:
    """fBm of cubic value noise at p (..., 3) in [-1, 1]: amplitudes halve as frequencies double; unit variance."""
    total, size = np.zeros(p.shape[:-1]), 16
    for octave in range(octaves):
        lattice = rng.normal(size=(size, size, size))
        place = np.moveaxis(p * frequency * 2.0**octave + rng.uniform(0, size, 3), -1, 0)
        total += 0.5**octave * map_coordinates(lattice, place, order=3, mode="grid-wrap")
    return total / total.std()


def density() -> np.ndarray:
    """Extinction (CELLS, CELLS, CELLS) in 1/scene unit; 0 from 0.97 RADIUS on, scaled to OPTICAL_DEPTH."""
    rng, p = np.random.default_rng(3), centres(CELLS)
    warp = np.stack([fractal_noise(p, 1.2, 2, rng) for _ in range(3)], -1)
    # wide and flat, its outline pushed about by the warp; the window keeps the border of the sphere free of matter
    distance = np.linalg.norm((p + 0.09 * warp) * (0.88, 1.2, 1.0), axis=-1)
    envelope = np.clip(1.25 - 1.3 * distance, 0, 1)
    window = np.clip((0.97 - np.linalg.norm(p, axis=-1)) / 0.1, 0, 1)
    sigma = window * np.clip(envelope + 0.45 * fractal_noise(p, 2.4, 4, rng) * np.sqrt(envelope) - 0.2, 0, None)
    across = 2 * RADIUS / CELLS * max(sigma.sum(axis).max() for axis in range(3))
    return sigma * (OPTICAL_DEPTH / across)


def albedo() -> np.ndarray:
    """Single-scattering albedo (COLOURS, COLOURS, COLOURS, 3): from coral below to a pale blue above."""
    rng, p = np.random.default_rng(4), centres(COLOURS)
    height = np.clip(0.5 + 0.8 * p[..., 1] + 0.12 * fractal_noise(p, 1.5, 2, rng), 0, 1)[..., None]
    height = height * height * (3 - 2 * height)
    return (1 - height) * (0.92, 0.42, 0.30) + height * (0.55, 0.78, 0.95)


def write(values: np.ndarray, path: Path) -> None:
    """Write (z, y, x) or (z, y, x, channel) as a .vol file."""
    path.parent.mkdir(exist_ok=True)
    mi.VolumeGrid(values.reshape(*values.shape[:3], -1).astype(np.float32)).write(str(path))
    print(f"{path.name}: {values.shape}, {values.min():.3f} .. {values.max():.3f}, {path.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    """Write both volumes."""
    mi.set_variant("scalar_rgb")
    folder = Path(__file__).parent / "volumes"
    write(density(), folder / "density.vol")
    write(albedo(), folder / "albedo.vol")


if __name__ == "__main__":
    main()
