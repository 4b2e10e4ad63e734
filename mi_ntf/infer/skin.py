"""The skins of a field, measured where it is baked (:mod:`mi_ntf.core.skin`)."""

from types import ModuleType

import drjit as dr
import numpy as np

from ..core import skin
from ..core.ops import dot
from . import ops
from .backend import floats
from .bake import REFLECTANCE_RESOLUTION, at_voxels, flat
from .bricks import of_dense
from .bundle import density_where, onward, safe_inverse
from .grid import bricks_of

OPAQUE = 0.5
"""Fields with fewer opaque skins than this share are smoke."""


class Softness:
    """Softness of a field's skins at any point, trilinear; 0 for flat skins, for smoke, and away from matter.

    `arrays`: result of :func:`measure`. `solid`: fraction of the skins that are opaque; `opaque`: True if most are.
    """

    def __init__(self, arrays: dict[str, np.ndarray], dj: ModuleType):
        self._bricks, self.solid = bricks_of(arrays, "softness", dj), float(arrays["solid"][0])
        self.opaque = self.solid >= OPAQUE

    def __call__(self, p):
        """Return the softness at the field points `p`."""
        return self._bricks.at(self._bricks.place(p))[0]


def measured(grid, dj: ModuleType) -> Softness:
    """Return the softness of `grid` (a :class:`mi_ntf.infer.grid.GridField`)."""
    return Softness(measure(grid, dj), dj)


def measure(grid, dj: ModuleType) -> dict[str, np.ndarray]:
    """Return the arrays of a :class:`Softness` of `grid` (a :class:`mi_ntf.infer.grid.GridField`)."""
    values, solid = _measure(grid, min(grid.resolution, REFLECTANCE_RESOLUTION), dj)
    arrays = of_dense(values[..., None], values > 0)
    return {f"softness.{name}": array for name, array in arrays.items()} | {"solid": np.array([solid])}


def _measure(grid, n: int, dj: ModuleType) -> tuple[np.ndarray, float]:
    """Return the softness (z, y, x), float32, and the fraction of skins that are opaque."""
    solid = 0.0
    result, known = np.zeros((n, n, n), np.float32), np.zeros((n, n, n), bool)
    index = np.flatnonzero(_occupied(grid, n, dj))
    normals = at_voxels(lambda p: flat(grid.reflectance(p)), 8, index, n, dj)[:, :3]

    def depth(way, most):
        """Optical depths from the voxels `index` along the directions `way` (k, 3)."""
        x, d = _centres(index, n, dj), tuple(floats(c, dj) for c in way.T)
        return _depth(grid, x, d, most).numpy()

    if len(index):
        out = depth(normals, skin.DEEPEST)
        seen = (out > 0) & (out < skin.DEEPEST)
        index, normals, out = index[seen], normals[seen], out[seen]
    if len(index):
        below = depth(-normals, skin.SOLID)
        known.ravel()[index] = True
        solid = float(np.mean(out + below > skin.SOLID))
        # Smoke has no skin: eight marches less for each of its voxels, which may be all there are.
        firm = out + below > skin.SMOKE
        index, normals, out, below = index[firm], normals[firm], out[firm], below[firm]
    if len(index):
        x, normal = _centres(index, n, dj), tuple(floats(c, dj) for c in normals.T)
        out, below = floats(out, dj), floats(below, dj)
        sigma, total = grid.density(x), dj.Float(0)
        for turn in skin.TURNS:
            d = skin.across(ops, normal, tuple(dr.opaque(dj.Float, c) for c in turn))
            total = total + skin.squared_horizon(ops, out, _depth(grid, x, d, skin.FLATTEST * out), sigma)
            dr.eval(total)
        result.ravel()[index] = skin.softness(ops, total / skin.AZIMUTHS, out, below).numpy()
    return spread(result, known), solid


def _centres(index: np.ndarray, n: int, dj: ModuleType) -> tuple:
    """Return the centres of the voxels `index` of n³, x first."""
    return tuple(floats((index // n**axis % n + 0.5) * (2 / n) - 1, dj) for axis in range(3))


def _occupied(grid, n: int, dj: ModuleType) -> np.ndarray:
    """Return which voxels of n³, x first, hold density."""
    return at_voxels(lambda p: [grid.density(p)], 1, None, n, dj)[:, 0] > 0


def _depth(grid, x, d, most):
    """∫ σ from `x` along `d` as far as ``skin.LENGTH``, or until it passes `most`."""
    floats = type(x[0])
    step, length = dr.opaque(floats, 1 / grid.resolution), skin.LENGTH
    inverse = safe_inverse(d)

    def body(t, depth, active):
        p = tuple(a + (t + 0.5 * step) * b for a, b in zip(x, d, strict=True))
        place = grid.place(p)
        skip = grid.clear_distance(place, inverse)
        depth = depth + density_where(active & (skip <= 0) & (dot(p, p) < 1), grid, place) * step
        t = t + onward(skip, step)
        return t, depth, active & (t < length) & (depth < most)

    n = dr.width(x)
    state = (dr.zeros(floats, n), dr.zeros(floats, n), dr.full(dr.mask_t(floats), True, n))
    return dr.while_loop(state=state, cond=lambda t, depth, active: active, body=body, label="skin")[1]


def spread(values: np.ndarray, known: np.ndarray, passes: int = 2) -> np.ndarray:
    """`values` (z, y, x), continued from where they are `known` to their neighbours' neighbours: what lies between is
    interpolated."""
    for _ in range(passes):
        weight = _box(known.astype(np.float32))
        mean = _box(np.where(known, values, 0)) / np.maximum(weight, 1e-6)
        values, known = np.where(known, values, mean), weight > 0.5
    return values.astype(np.float32)


def _box(values: np.ndarray) -> np.ndarray:
    """Sums over 3³ neighbours."""
    for axis in range(3):
        padded = np.pad(values, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        n = values.shape[axis]
        first, second, third = (padded.take(range(k, k + n), axis) for k in range(3))
        values = first + second + third
    return values
