"""Softness and thickness of a field's skins (:mod:`mi_ntf.core.skin`), measured by marches through the field."""

import math
from types import ModuleType

import drjit as dr
import numpy as np

from ..core import skin
from ..core.architecture import LOG_FLOOR
from ..core.ops import dot
from . import ops
from .backend import floats
from .bake import REFLECTANCE_RESOLUTION, Progress, at_voxels
from .bricks import of_dense
from .bundle import density_where, onward, safe_inverse
from .grid import Density, GridField, bricks_of
from .network import NetworkField
from .types import Array, Float, Mask, Vector

OPAQUE = 0.5
"""Fraction of opaque skins below which a field is smoke."""
PROBES, NEAR, SLOPE = 1 << 16, 1 / 192, 1 / 1536
"""Random points at which the networks' skins are probed; reach of points around those with matter, and half of the
length over which slopes are taken, field units."""


class Softness:
    """Softness of a field's skins at any point, trilinear; 0 for flat skins, in smoke and far from matter.

    `arrays`: result of :func:`measure`. `solid`: fraction of the skins that are opaque; `opaque`: True if most are;
    `thickness`: scale height of the thinner quarter of them (:data:`mi_ntf.core.skin.THIN`), field units.
    """

    def __init__(self, arrays: dict[str, np.ndarray], dj: ModuleType):
        self._bricks = bricks_of(arrays, "softness", dj)
        self.solid, self.thickness = (float(arrays[name][0]) for name in ("solid", "thickness"))
        self.opaque = self.solid >= OPAQUE

    def __call__(self, p: Vector) -> Float:
        """Return the softness at the field points `p`."""
        return self._bricks.at(self._bricks.place(p))[0]


class Smoke:
    """Softness of matter without skins."""

    opaque, solid, thickness = False, 0.0, math.inf

    def __call__(self, p: Vector) -> Float:
        """Return 0 at the points `p`."""
        return dr.zeros(type(p[0]), dr.width(p[0]))


def measured(grid: GridField, dj: ModuleType) -> Softness:
    """Return the softness of `grid`."""
    return Softness(measure(grid, dj), dj)


def measure(grid: Density, dj: ModuleType, progress: Progress = lambda done: None) -> dict[str, np.ndarray]:
    """Return the arrays of a :class:`Softness` of `grid`; `progress` receives the fraction of the work that is done."""
    values, solid, thickness = _measure(grid, min(grid.resolution, REFLECTANCE_RESOLUTION), dj, progress)
    arrays = of_dense(values[..., None], values > 0)
    return ({f"softness.{name}": array for name, array in arrays.items()}
            | {"solid": np.array([solid]), "thickness": np.array([thickness])})


def _measure(grid: Density, n: int, dj: ModuleType, progress: Progress) -> tuple[np.ndarray, float, float]:
    """Return the softness (z, y, x), float32, the fraction of skins that are opaque, and their thickness."""
    solid, thickness = 0.0, math.inf
    result, known = np.zeros((n, n, n), np.float32), np.zeros((n, n, n), bool)
    index = np.flatnonzero(_occupied(grid, n, dj))
    normals = at_voxels(lambda p: list(grid.reflectance(p)[0]), 3, index, n, dj)

    def depth(directions: np.ndarray, limit: float) -> np.ndarray:
        """Return the optical depths from the voxels `index` along the `directions` (k, 3)."""
        x, d = _centres(index, n, dj), tuple(floats(c, dj) for c in directions.T)
        depths: np.ndarray = _depth(grid, x, d, limit).numpy()
        return depths

    if len(index):
        out = depth(normals, skin.DEEPEST)
        visible = (out > 0) & (out < skin.DEEPEST)
        index, normals, out = index[visible], normals[visible], out[visible]
    if len(index):
        inward = depth(-normals, skin.SOLID)
        known.ravel()[index] = True
        solid = float(np.mean(out + inward > skin.SOLID))
        # Smoke has no skin, which saves eight marches for each of its voxels.
        firm = out + inward > skin.SMOKE
        index, normals, out, inward = index[firm], normals[firm], out[firm], inward[firm]
    if len(index):
        x, normal = _centres(index, n, dj), tuple(floats(c, dj) for c in normals.T)
        out, inward = floats(out, dj), floats(inward, dj)
        sigma, total = grid.density(x), dj.Float(0)
        thickness = _thickness(grid, x, normal, inward, 2 / n, dj)
        for number, turn in enumerate(skin.TURNS):
            progress((2 + number) / (2 + len(skin.TURNS)))
            d = skin.across(ops, normal, tuple(dr.opaque(dj.Float, c) for c in turn))
            total = total + skin.squared_horizon(ops, out, _depth(grid, x, d, skin.FLATTEST * out), sigma)
            dr.eval(total)
        result.ravel()[index] = skin.softness(ops, total / skin.AZIMUTHS, out, inward).numpy()
    return spread(result, known), solid, thickness


def _thickness(grid: Density, x: Vector, normal: Vector, inward: Float, width: float, dj: ModuleType) -> float:
    """Return the thickness of skins at random points of the voxels around `x`, of a `width` in field units.

    Centres would not do: they may lie at the nodes of a finer grid.
    """
    rng = np.random.default_rng(0)
    p = tuple(c + floats(rng.uniform(-width / 2, width / 2, dr.width(c)), dj) for c in x)
    out = _depth(grid, p, normal, skin.DEEPEST)
    return skin.thickness(out.numpy(), inward.numpy(), grid.density(p).numpy())


def scale_height(field: NetworkField, dj: ModuleType) -> float:
    """Return the scale height of the thinner skins of `field`, read off the slope of ln σ; infinity if it has none."""
    rng = np.random.default_rng(0)

    def log_density(p: np.ndarray) -> np.ndarray:
        values: np.ndarray = field.log_density(tuple(floats(c, dj) for c in p)).numpy().astype(np.float64)
        return values

    p = rng.uniform(-1, 1, (3, PROBES))
    p = p[:, log_density(p) > LOG_FLOOR]
    if not p.shape[1]:
        return math.inf
    p = np.repeat(p, -(-PROBES // p.shape[1]), 1)
    p += rng.uniform(-NEAR, NEAR, p.shape)
    slope = [log_density(p + h) - log_density(p - h) for h in SLOPE * np.eye(3)[:, :, None]]
    height = 2 * SLOPE / np.maximum(np.linalg.norm(slope, axis=0), 1e-9)
    sigma = np.exp(log_density(p))
    inward = np.full(len(height), skin.SOLID)  # all matter is taken to be opaque: no march tells
    return skin.thickness(sigma * height, inward, sigma)


def _centres(index: np.ndarray, n: int, dj: ModuleType) -> tuple[Float, ...]:
    """Return the centres of the voxels `index` of n³, x first."""
    return tuple(floats((index // n**axis % n + 0.5) * (2 / n) - 1, dj) for axis in range(3))


def _occupied(grid: Density, n: int, dj: ModuleType) -> np.ndarray:
    """Return a mask of the voxels of n³, x fastest, that hold density."""
    mask: np.ndarray = at_voxels(lambda p: [grid.density(p)], 1, None, n, dj)[:, 0] > 0
    return mask


def _depth(grid: Density, x: Vector, d: Vector, limit: Float) -> Float:
    """Return ∫ σ from `x` along `d` as far as ``skin.LENGTH``, or until it exceeds `limit`."""
    floats = type(x[0])
    step, length = dr.opaque(floats, 1 / grid.resolution), skin.LENGTH
    inverse = safe_inverse(d)

    def body(t: Float, depth: Float, active: Mask) -> tuple[Array, ...]:
        p = tuple(a + (t + 0.5 * step) * b for a, b in zip(x, d, strict=True))
        place = grid.place(p)
        skip = grid.clear_distance(place, inverse)
        depth = depth + density_where(active & (skip <= 0) & (dot(p, p) < 1), grid, place) * step
        t = t + onward(skip, step)
        return t, depth, active & (t < length) & (depth < limit)

    n = dr.width(x)
    state = (dr.zeros(floats, n), dr.zeros(floats, n), dr.full(dr.mask_t(floats), True, n))
    return ops.while_loop(state=state, cond=lambda t, depth, active: active, body=body, label="skin")[1]


def spread(values: np.ndarray, known: np.ndarray, passes: int = 2) -> np.ndarray:
    """Return `values` (z, y, x), continued from the `known` voxels to their neighbours, once per pass.

    Interpolation next to the known voxels then reads defined values.
    """
    for _ in range(passes):
        weight = _box(known.astype(np.float32))
        mean = _box(np.where(known, values, 0)) / np.maximum(weight, 1e-6)
        values, known = np.where(known, values, mean), weight > 0.5
    return values.astype(np.float32)


def _box(values: np.ndarray) -> np.ndarray:
    """Return the sums over 3³ neighbours."""
    for axis in range(3):
        padded = np.pad(values, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        n = values.shape[axis]
        first, second, third = (padded.take(range(k, k + n), axis) for k in range(3))
        values = first + second + third
    return values
