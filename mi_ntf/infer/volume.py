"""Density of a participating medium: trilinear voxels of extinction, as in ``gridvolume``, in a body."""

import copy
import hashlib
from types import ModuleType

import drjit as dr
import numpy as np

from ..core.microfacet import MIN_ROUGHNESS
from ..core.ops import normalize
from ..core.spheres import fibonacci
from ..core.voxels import ARRAYS, Voxels
from . import bricks, ops
from .convex import Convex, box
from .grid import PlacedVoxels, bricks_of
from .network import NOTHING, coloured, density_of
from .types import Float, Place, Reflected, Vector

FAINTEST = 1e-20
"""Extinction, 1/(unit-sphere radius), below which there is no matter."""
ROUGHNESS, SPECULAR = 6, 7
"""First channels of a surface's reflectance after its normal and its albedo; the specular weight has one or three."""
DIRECTIONS = 1200
"""Number of directions along which the furthest points of the matter make its hull."""


class Placed:
    """Bricks whose voxels, `counts` along each axis, fill the box from `low` to `high`, field coordinates.

    The voxels may have another length along each axis, so points are scaled to the cubic voxels of the bricks.
    """

    def __init__(self, content: bricks.Bricks, counts: np.ndarray, low: np.ndarray, high: np.ndarray, dj: ModuleType):
        self.bricks, self.counts = content, np.asarray(counts, np.float64)
        self.low, self.high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        size = np.asarray(high, np.float64) - low
        self.resolution = int(np.ceil((2 * self.counts / size).max()))
        scale = 2 * self.counts / (content.resolution * size)
        offset, last = -1 - scale * low, (self.counts - 0.5) * 2 / content.resolution - 1
        self._scale, self._offset, self._last, self._inverse = (
            tuple(dr.opaque(dj.Float, float(v)) for v in row) for row in (scale, offset, last, 1 / scale))

    def place(self, p: Vector) -> Place:
        """Return the places of `p` in the bricks."""
        return self.bricks.place(tuple(ops.fmin(dr.fma(c, s, o), last) for c, s, o, last in zip(
            p, self._scale, self._offset, self._last, strict=True)))

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs through empty bricks."""
        return self.bricks.clear_distance(place, tuple(
            i * s for i, s in zip(inverse_d, self._inverse, strict=True)))

    @property
    def voxels(self) -> PlacedVoxels:
        """The bricks and their place."""
        return PlacedVoxels(self.bricks, self.counts.astype(int), self.low, self.high)


class Solid(Convex):
    """A body of voxels in a box: it is inside where the interpolated fraction of a voxel that lies inside exceeds ½.

    That follows a smooth surface to a small part of a voxel, where a density that fades out over a voxel would grow
    dense bodies by one.

    `fractions`: (z, y, x), in [0, 1]; `low`, `high`: corners of the box, field coordinates.
    """

    def __init__(self, fractions: np.ndarray, low: np.ndarray, high: np.ndarray, dj: ModuleType):
        super().__init__(box(low, high), None, dj)
        content = bricks.Bricks(bricks.of_dense(fractions[..., None], fractions > 0), dj)
        self._voxels = Placed(content, np.array(fractions.shape[::-1]), low, high, dj)
        self.nbytes, self.resolution = content.nbytes, self._voxels.resolution
        self._fractions = fractions

    def arrays(self) -> list[np.ndarray]:
        """Return the numbers that define the body."""
        return [*super().arrays(), self._fractions]

    def place(self, p: Vector) -> Place:
        """Return a mask of the points `p` that lie inside, first, and their places in the bricks."""
        place = self._voxels.place(p)
        return self.inside(p) & (self._voxels.bricks.at(place)[0] > 0.5), *place

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs through empty bricks."""
        return self._voxels.clear_distance(place[1:], inverse_d)


class VoxelVolume:
    """Extinction inside the unit sphere, a :class:`mi_ntf.infer.grid.Density`.

    Parameters
    ----------
    arrays
        Bricks ``density.*`` of extinction, 1/(unit-sphere radius), and ``reflectance.*`` of 3 or 8 channels, if any
        (:mod:`mi_ntf.core.voxels`). Raises ValueError if they cannot be that.
    header
        Number of the voxels along each axis, and the albedo where there are no bricks of reflectance.
    low, high
        Corners of the box that the voxels fill, field coordinates.
    body
        Body outside of which there is no matter.
    hull
        (k, 3) points whose convex hull holds all matter.
    dj
        Dr.Jit module of the back end.
    constant
        Extinction, 1/(unit-sphere radius), if it is the same throughout a convex body, whose extent is exact.
    """

    def __init__(self, arrays: dict[str, np.ndarray], header: Voxels, low: np.ndarray, high: np.ndarray, body: Convex,
                 hull: np.ndarray, dj: ModuleType, constant: float | None = None):
        self.body, self.hull, self._dj, self.constant = body, hull, dj, constant
        density = bricks_of(arrays, "density", dj)
        self._density = Placed(density, np.array(header.counts), low, high, dj)
        self._albedo = tuple(dr.opaque(dj.Float, value) for value in header.albedo)
        self._reflectance = None if header.reflectance_counts is None else Placed(
            bricks_of(arrays, "reflectance", dj), np.array(header.reflectance_counts), low, high, dj)
        self.bounds = hull.min(0), hull.max(0)
        self.majorant, self.gloss = _highest(arrays["density.range"]), _gloss(arrays)
        self.resolution = max(self._density.resolution, body.resolution)
        digest = hashlib.sha256(repr((header.counts, header.reflectance_counts, header.albedo, header.phase)).encode())
        for name in sorted(arrays):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(arrays[name]).data)
        for array in (low, high, *body.arrays(), hull):
            digest.update(np.ascontiguousarray(array, np.float64).data)
        self.digest = digest.hexdigest()

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        reflectance = self._reflectance.bricks.nbytes if self._reflectance else 0
        return self._density.bricks.nbytes + reflectance + self.body.nbytes

    @property
    def density_voxels(self) -> PlacedVoxels:
        """Voxels of extinction."""
        return self._density.voxels

    @property
    def reflectance_voxels(self) -> PlacedVoxels | None:
        """Voxels of the reflectance; None if it is an albedo that is the same everywhere."""
        return self._reflectance.voxels if self._reflectance else None

    def with_density(self, content: bricks.Bricks, majorant: float, hull: np.ndarray) -> "VoxelVolume":
        """Return a copy with other bricks of extinction."""
        result = copy.copy(self)
        result._density = copy.copy(self._density)
        result._density.bricks = content
        result.majorant, result.hull, result.bounds = majorant, hull, (hull.min(0), hull.max(0))
        return result

    def density(self, p: Vector) -> Float:
        """Return σ at `p`, 1/(unit-sphere radius)."""
        return density_of(self.log_density(self.place(p)))

    def reflectance(self, p: Vector) -> Reflected:
        """Return normal, albedo, roughness and specular weight at `p`; without a surface 0, the albedo, 1 and 0."""
        width = dr.width(p[0])
        zero, one = dr.zeros(type(p[0]), width), dr.ones(type(p[0]), width)
        if self._reflectance is None:
            return (zero, zero, zero), tuple(one * value for value in self._albedo), one, (zero, zero, zero)
        values = self._reflectance.bricks.at(self._reflectance.place(p))
        if len(values) == 3:
            return (zero, zero, zero), tuple(values), one, (zero, zero, zero)
        normal = normalize(ops, tuple(values[:3]))
        roughness = dr.maximum(values[ROUGHNESS], MIN_ROUGHNESS)
        return normal, tuple(values[3:6]), roughness, coloured(values[SPECULAR:])

    def place(self, p: Vector) -> Place:
        """Return the places of `p` in the bricks and in the body."""
        return self._density.place(p), self.body.place(p)

    def log_density(self, place: Place) -> Float:
        """Return ln σ at a place, ``NOTHING`` outside the body."""
        sigma = self._density.bricks.at(place[0])[0]
        return dr.select(place[1][0] & (sigma > FAINTEST), dr.log(sigma), NOTHING)

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs through empty bricks."""
        return dr.maximum(self._density.clear_distance(place[0], inverse_d),
                          self.body.clear_distance(place[1], inverse_d))

    def extent(self, m: Vector, d: Vector, h: Float) -> tuple[Float, Float]:
        """Return begin and end, t', of the part of a chord inside the body (:meth:`Convex.extent`)."""
        return self.body.extent(m, d, h)


def of_file(header: Voxels, arrays: dict[str, np.ndarray], dj: ModuleType) -> VoxelVolume:
    """Return the volume of a file of voxels; raise ValueError if its arrays are no bricks."""
    for part in ("density",) if header.reflectance_counts is None else ("density", "reflectance"):
        bricks.check({name: arrays[f"{part}.{name}"] for name in ARRAYS})
    sphere = header.similarity
    low, high = ((np.array(corner) - sphere.center) / sphere.radius for corner in (header.low, header.high))
    scaled = arrays | {"density.range": (arrays["density.range"] * sphere.radius).astype(np.float32)}
    hull = hull_of(arrays["density.index"], np.array(header.counts), low, high)
    return VoxelVolume(scaled, header, low, high, Convex(box(low, high), None, dj), hull, dj)


def dense(values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays ``density.*`` of extinction (z, y, x)."""
    return {f"density.{name}": array for name, array in bricks.of_dense(values[..., None], values > FAINTEST).items()}


def _highest(ranges: np.ndarray) -> float:
    return float(ranges[0, 0]) + 0xFFFF * float(ranges[1, 0]) if np.abs(ranges).max() > 0 else 0.0


def _gloss(arrays: dict[str, np.ndarray]) -> float:
    """Return the highest specular lobe, s/(4 α²), of a surface's reflectance; 0 if there is none."""
    ranges = arrays.get("reflectance.range", np.zeros((2, 0)))
    weights = [_channel(arrays, channel) for channel in range(SPECULAR, ranges.shape[1])]
    if not any(weight.any() for weight in weights):
        return 0.0
    roughness, specular = _channel(arrays, ROUGHNESS), np.max(weights, axis=0)
    gloss: np.ndarray = specular / (4 * np.maximum(roughness, MIN_ROUGHNESS) ** 4)
    return float(gloss[roughness > 0].max(initial=0.0))


def _channel(arrays: dict[str, np.ndarray], channel: int) -> np.ndarray:
    low, step = arrays["reflectance.range"][:, channel]
    values: np.ndarray = low + step * (arrays["reflectance.words"][:, channel] & 0xFFFF).astype(np.float32)
    return values


def hull_of(index: np.ndarray, counts: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the furthest corners (k, 3), x first, of the octants that hold matter, along many directions."""
    octants = bricks.octants_with_matter(index)
    first, end = octants.argmax(2), octants.shape[2] - octants[:, :, ::-1].argmax(2)  # of each line along x
    z, y = np.nonzero(octants.any(2))
    if not len(z):
        return np.zeros((1, 3))
    half = bricks.SIDE // 2
    corners = np.concatenate([np.stack([half * (x[z, y] + 0), half * (y + b), half * (z + c)], 1)
                              for x in (first, end) for b in (0, 1) for c in (0, 1)]).astype(np.float64)
    # Matter continues from the first and last centres to the faces of the box.
    corners = np.where(corners <= 0, 0, np.where(corners >= counts - 1, counts, corners + 0.5))
    points = np.unique(low + corners / counts * (high - low), axis=0)
    fan = np.concatenate([fibonacci(DIRECTIONS), np.eye(3), -np.eye(3)])
    furthest = np.concatenate([(points @ part.T).argmax(0) for part in np.array_split(fan, 40)])
    result: np.ndarray = points[np.unique(furthest)]
    return result
