"""The field baked into voxels: the fast path, and the one that stock integrators see."""

from types import ModuleType

import drjit as dr
import numpy as np

from ..core.architecture import LOG_FLOOR
from ..core.ops import normalize
from . import ops
from .backend import floats
from .network import MIN_DENSITY, NetworkField, cut_log_density, density_of

CELLS = 64
"""Resolution of the occupancy grid that marches skip by."""


SURVEY = 192
"""Voxels per side at which density is looked for first: finer voxels are baked where there is some nearby."""
REFLECTANCE_RESOLUTION = 128
"""Voxels per side of what takes eight times the memory of density, or many marches to find: no finer than this."""


class GridField:
    """Density of `field`, sampled once at voxel centres of [−1, 1]³, trilinear between, and its reflectance.

    Density is baked as ln σ at `resolution`³: the networks' own σ is the exponential of a smooth function, which
    trilinear ln σ follows far closer than trilinear σ does. Voxels hold a little more than ln σ where it bends down, so
    that what lies between them is right on average: straight lines run below it there, and skins of a voxel's thickness
    lost a tenth of a pixel of the outline and half of its light.

    Reflectance is asked of shading points alone, few beside the steps of marches: of networks of planes, which cost no
    more than some fetches. Voxels of it as fine as the planes' products would take gigabytes, and those of 128³ took
    0.8 % of a picture's 14 % error. Other networks are baked, at ``REFLECTANCE_RESOLUTION``³ at most.

    Also holds the occupancy: `clearance` (``CELLS``³ floats) is the Chebyshev distance, in cells, to the nearest cell
    with density anywhere in it; `bounds`, the box around all density; `hull` (k, 3), points whose convex hull holds
    it; `majorant`, an upper bound of the density; `gloss`, the highest specular lobe in matter, s/(4 α²): light and
    view along the normal, relative to a white diffuse surface.
    """

    def __init__(self, field: NetworkField, resolution: int, dj: ModuleType):
        self.dj, self.resolution, self._field = dj, resolution, field
        self._log_sigma = _Voxels(_coefficients(baked_log_density(field, resolution, dj), dj), dj)
        log_sigma = self._log_sigma.values()
        coarse = min(resolution, REFLECTANCE_RESOLUTION)
        self._reflectance = None
        if not field.quick:
            values = _evaluate(lambda p: _flat(field.reflectance(p)), 8, np.arange(coarse**3), coarse, dj)
            self._reflectance = _texture(values.reshape(coarse, coarse, coarse, 8), dj)
        dense = log_sigma > np.log(MIN_DENSITY)
        self.gloss = _highest_gloss(self, dense, coarse)
        self.majorant = float(np.exp(log_sigma.max())) if dense.any() else 0.0
        occupied = _occupied_cells(dense)
        self.clearance = floats(_chebyshev_distance(occupied), dj)
        self.hull = _support_points(dense)
        self.bounds = self.hull.min(0), self.hull.max(0)

    def density(self, p):
        """σ at `p`, 1/(unit-sphere radius)."""
        return density_of(self.cut_log_density(p))

    def cut_log_density(self, p):
        """ln σ at `p`, ``NOTHING`` where there is none: wherever `clearance` says so, among others."""
        return cut_log_density(self._log_sigma(p), p)

    def reflectance(self, p):
        """As :meth:`NetworkField.reflectance`."""
        if self._reflectance is None:
            return self._field.reflectance(p)
        v = self._reflectance.eval(self._uvw(p))
        return normalize(ops, tuple(v[:3])), tuple(v[3:6]), v[6], v[7]

    def _uvw(self, p):
        return self.dj.Array3f(*(0.5 * c + 0.5 for c in p))


def _highest_gloss(grid: GridField, dense: np.ndarray, n: int) -> float:
    """s/(4 α²), the most at the centres of all of n³ voxels that hold some of the voxels `dense`."""
    at = np.arange(dense.shape[0]) * n // dense.shape[0]
    index = np.flatnonzero(_any(dense, at, at, n))
    roughness, specular = _evaluate(lambda p: grid.reflectance(p)[2:], 2, index, n, grid.dj).T
    return float((specular / (4 * roughness**4)).max(initial=0.0))


def baked_log_density(field: NetworkField, n: int, dj: ModuleType) -> np.ndarray:
    """ln σ at the centres of n³ voxels (z, y, x); ``LOG_FLOOR`` where a survey found less all around."""
    values = np.full(n**3, LOG_FLOOR, np.float32)
    if n > SURVEY:
        near = _chebyshev_distance(baked_log_density(field, SURVEY, dj) > LOG_FLOOR, 2) <= 1
        at = (2 * np.arange(n) + 1) * SURVEY // (2 * n)
        index = np.flatnonzero(near.take(at, 2).take(at, 1).take(at, 0))
    else:
        index = np.arange(n**3)
    values[index] = _evaluate(lambda p: [field.log_density(p)], 1, index, n, dj)[:, 0]
    return values.reshape(n, n, n)


def _coefficients(log_sigma: np.ndarray, dj: ModuleType) -> np.ndarray:
    """Values between which trilinear interpolation is right on average, f − f″/12 along each axis of (z, y, x) (Condat
    and Möller 2011, quasi-interpolation); none above the highest."""
    n, values = log_sigma.shape[0], dj.Float(np.maximum(log_sigma, LOG_FLOOR).ravel())
    here = dr.arange(dj.UInt32, n**3)
    for stride in (1, n, n * n):
        dr.eval(values)  # their neighbours are fetched
        place, step = here // stride % n, dr.opaque(dj.UInt32, stride)
        sides = (dr.gather(dj.Float, values, dr.select(place == end, here, beside))
                 for end, beside in ((0, here - step), (n - 1, here + step)))
        values = (14 * values - sum(sides)) / 12
    return dr.minimum(values, dr.opaque(dj.Float, float(log_sigma.max()))).numpy().reshape(log_sigma.shape)


class _Voxels:
    """Trilinear numbers of `values` (z, y, x) on [−1, 1]³, to 1/65535 of their range. A word holds a voxel and the next
    one along x: four fetches a point in place of the eight of a Dr.Jit texture, which take 0.7 of the time."""

    def __init__(self, values: np.ndarray, dj: ModuleType):
        n, low = values.shape[0], float(values.min())
        step = max(float(values.max()) - low, 1e-6) / 0xFFFF
        levels = np.round((values - low) / step).astype(np.uint32)
        levels[:, :, :-1] |= levels[:, :, 1:] << 16
        levels[:, :, -1] |= levels[:, :, -1] << 16
        # Dr.Jit's own copy: NumPy's memory, aligned by chance, would compile kernels anew, and counts as nobody's.
        self._dj, self._words = dj, dj.UInt32(levels.ravel()) | dr.opaque(dj.UInt32, 0)
        dr.eval(self._words)
        self._half, self._last, self._low, self._step = (dr.opaque(dj.Float, v) for v in (n / 2, n - 1, low, step))
        self._end, self._line, self._layer = (dr.opaque(dj.UInt32, v) for v in (n - 2, n, n * n))

    def values(self) -> np.ndarray:
        """Those of the voxels, float32."""
        n = int(self._end[0]) + 2
        levels = (self._words.numpy() & 0xFFFF).reshape(n, n, n)
        return (np.float32(self._low[0]) + np.float32(self._step[0]) * levels).astype(np.float32)

    def __call__(self, p):
        """At the field points `p`; those outside of the voxels' centres, as on the nearest ones."""
        place = [dr.clip(self._half * c + (self._half - 0.5), 0, self._last) for c in p]
        x, y, z = (dr.minimum(self._dj.UInt32(f), self._end) for f in place)
        fx, fy, fz = (f - self._dj.Float(i) for f, i in zip(place, (x, y, z), strict=True))
        first = z * self._layer + y * self._line + x

        def along_x(index):
            word = dr.gather(self._dj.UInt32, self._words, index)
            low = self._dj.Float(word & 0xFFFF)
            return low + fx * (self._dj.Float(word >> 16) - low)

        def along_y(index):
            low = along_x(index)
            return low + fy * (along_x(index + self._line) - low)

        low = along_y(first)
        return self._low + self._step * (low + fz * (along_y(first + self._layer) - low))


def _flat(reflectance) -> list:
    normal, albedo, roughness, specular = reflectance
    return [*normal, *albedo, roughness, specular]


def _texture(values: np.ndarray, dj: ModuleType):
    return dj.Texture3f(
        dj.TensorXf(np.ascontiguousarray(values, np.float32)), use_accel=False, wrap_mode=dr.WrapMode.Clamp
    )


def _evaluate(function, count: int, index: np.ndarray, n: int, dj: ModuleType) -> np.ndarray:
    """``function(p)``, a list of `count` arrays, at the centres of the voxels `index` of n³, x first: (len(index),
    count), float32. Parts of a million bound the memory."""
    result = np.empty((len(index), count), np.float32)
    side, size = dr.opaque(dj.UInt32, n), dr.opaque(dj.Float, 2 / n)
    for first in range(0, len(index), 1 << 20):
        voxel = dj.UInt32(index[first : first + (1 << 20)].astype(np.uint32))
        place = voxel % side, voxel // side % side, voxel // (side * side)
        values = function(tuple((dj.Float(c) + 0.5) * size - 1 for c in place))
        dr.eval(values)
        for k, v in enumerate(values):
            result[first : first + len(voxel), k] = v.numpy()
    return result


def _occupied_cells(dense: np.ndarray) -> np.ndarray:
    """Cells (z, y, x) of the occupancy grid that interpolation between the voxels `dense` gives any density."""
    n = dense.shape[0]
    # A voxel's density reaches one voxel to each side of its centre.
    first = np.floor((np.arange(n) - 0.5) / n * CELLS - 1e-4)
    last = np.floor((np.arange(n) + 1.5) / n * CELLS + 1e-4)
    return _any(dense, first, last, CELLS)


def _any(dense: np.ndarray, first: np.ndarray, last: np.ndarray, cells: int) -> np.ndarray:
    """Which of cells³ cells (z, y, x) any of the voxels `dense` reaches, along each axis from the `first` to the `last`
    of its indices."""
    for axis in range(3):
        parts = [dense.compress((first <= k) & (k <= last), axis).any(axis) for k in range(cells)]
        dense = np.stack(parts, axis)
    return dense


def _support_points(dense: np.ndarray, directions: int = 1200) -> np.ndarray:
    """Points that lie furthest along many directions of all that interpolation between the voxels `dense` (z, y, x) can
    reach, (k, 3) float64; the origin where there are none. What their hull misses has hardly any density: 1e-4 on
    average, 0.005 at most, along directions in between (four objects)."""
    n = dense.shape[0]
    lines = np.argwhere(dense.any(2))
    if not len(lines):
        return np.zeros((1, 3))
    rows = dense[tuple(lines.T)]
    ends = np.concatenate([rows.argmax(1), n - 1 - rows[:, ::-1].argmax(1)])
    voxels = np.concatenate([ends[:, None], np.tile(lines[:, ::-1], (2, 1))], 1)
    points = (voxels + 0.5) * (2 / n) - 1
    z = 1 - (np.arange(directions) + 0.5) * 2 / directions
    phi = np.arange(directions) * np.pi * (3 - 5**0.5)
    fan = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], 1)
    fan = np.concatenate([fan, np.eye(3), -np.eye(3)])
    furthest = np.concatenate([(points @ part.T).argmax(0) for part in np.array_split(fan, 40)])
    reach = np.where(fan < 0, -2 / n, 2 / n)  # a voxel fades out at its neighbours
    return np.clip(np.unique(points[furthest] + reach, axis=0), -1, 1)


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
