"""The field baked into voxels: the fast path, and the one that stock integrators see."""

from types import ModuleType

import drjit as dr
import numpy as np

from ..core.ops import normalize
from . import ops
from .network import NetworkField

CELLS = 64
"""Resolution of the occupancy grid that marches skip by."""


class GridField:
    """Density and reflectance of `field`, sampled once at `resolution`³ voxel centres of [−1, 1]³, trilinear between.

    Also holds the occupancy: `clearance` (``CELLS``³ floats) is the Chebyshev distance, in cells, to the nearest cell
    with density anywhere in it; `radius`, the radius of the smallest origin-centred ball around all density;
    `majorant`, the largest density. Memory: 36 bytes a voxel.
    """

    def __init__(self, field: NetworkField, resolution: int, dj: ModuleType):
        self.dj = dj
        sigma, reflectance = _bake(field, resolution, dj)
        self.majorant = float(sigma.max())
        self._sigma = _texture(sigma[..., None], dj)
        self._reflectance = _texture(reflectance, dj)
        occupied = _occupied_cells(sigma)
        self.clearance = dj.Float(_chebyshev_distance(occupied).ravel())
        centres = (np.argwhere(occupied)[:, ::-1] + 0.5) * (2 / CELLS) - 1
        reach = np.linalg.norm(np.abs(centres) + 1 / CELLS, axis=1).max() if len(centres) else 0.0
        self.radius = float(min(reach, 1.0))
        box = (centres.min(0) - 1 / CELLS, centres.max(0) + 1 / CELLS) if len(centres) else (np.zeros(3), np.zeros(3))
        self.bounds = tuple(np.clip(side, -1, 1) for side in box)

    def density(self, p):
        """σ at `p`, 1/(unit-sphere radius)."""
        inside = (dr.abs(p[0]) < 1) & (dr.abs(p[1]) < 1) & (dr.abs(p[2]) < 1)
        return dr.select(inside, self._sigma.eval(self._uvw(p))[0], 0)

    def reflectance(self, p):
        """As :meth:`NetworkField.reflectance`."""
        v = self._reflectance.eval(self._uvw(p))
        return normalize(ops, tuple(v[:3])), tuple(v[3:6]), v[6], v[7]

    def _uvw(self, p):
        return self.dj.Array3f(*(0.5 * c + 0.5 for c in p))


def _texture(values: np.ndarray, dj: ModuleType):
    return dj.Texture3f(
        dj.TensorXf(np.ascontiguousarray(values, np.float32)), use_accel=False, wrap_mode=dr.WrapMode.Clamp
    )


def _bake(field: NetworkField, resolution: int, dj: ModuleType) -> tuple[np.ndarray, np.ndarray]:
    """σ (z, y, x) and reflectance (z, y, x, 8), one slab of z at a time to bound the memory."""
    axis = (np.arange(resolution, dtype=np.float32) + 0.5) * (2 / resolution) - 1
    y, x = (dj.Float(v.ravel()) for v in np.meshgrid(axis, axis, indexing="ij"))
    sigma = np.empty((resolution,) * 3, np.float32)
    reflectance = np.empty((resolution,) * 3 + (8,), np.float32)
    for k, z in enumerate(axis):
        p = (x, y, dr.opaque(dj.Float, float(z)))
        normal, albedo, roughness, specular = field.reflectance(p)
        values = [field.density(p), *normal, *albedo, roughness, specular]
        dr.eval(values)
        values = np.stack([np.broadcast_to(v.numpy(), x.shape) for v in values], -1)
        sigma[k] = values[:, 0].reshape(resolution, resolution)
        reflectance[k] = values[:, 1:].reshape(resolution, resolution, 8)
    return sigma, reflectance


def _occupied_cells(sigma: np.ndarray) -> np.ndarray:
    """Cells (z, y, x) of the occupancy grid that trilinear interpolation of `sigma` gives any density."""
    n = sigma.shape[0]
    occupied = np.zeros((CELLS,) * 3, bool)
    # A voxel's density reaches one voxel to each side of its centre.
    k, j, i = np.nonzero(sigma > 0)
    low = [np.clip(np.floor((c - 0.5) / n * CELLS - 1e-4), 0, CELLS - 1).astype(int) for c in (k, j, i)]
    high = [np.clip(np.floor((c + 1.5) / n * CELLS + 1e-4), 0, CELLS - 1).astype(int) for c in (k, j, i)]
    spread = max((int((b - a).max()) for a, b in zip(low, high, strict=True)), default=0) if len(k) else 0
    for dz, dy, dx in np.ndindex(*(spread + 1,) * 3):
        occupied[tuple(np.minimum(a + d, b) for a, b, d in zip(low, high, (dz, dy, dx), strict=True))] = True
    return occupied


def _chebyshev_distance(occupied: np.ndarray, limit: int = 16) -> np.ndarray:
    """Distance in cells to the nearest occupied cell (0 in one), at most `limit`; (z, y, x) float32."""
    distance = np.zeros(occupied.shape, np.float32)
    reached = occupied
    for _ in range(limit):
        distance += ~reached
        for axis in range(3):
            padded = np.pad(reached, [(1, 1) if a == axis else (0, 0) for a in range(3)])
            n = occupied.shape[axis]
            reached = (
                padded.take(range(n), axis) | padded.take(range(1, n + 1), axis) | padded.take(range(2, n + 2), axis)
            )
    return distance
