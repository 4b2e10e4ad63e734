"""Density of a participating medium: trilinear voxels of extinction, as in ``gridvolume``, in a convex body."""

import hashlib
from types import ModuleType

import drjit as dr
import numpy as np

from . import bricks, ops
from .convex import Convex
from .network import NOTHING, density_of
from .types import Float, Place, Reflected, Vector

FAINTEST = 1e-20
"""Extinction, 1/(unit-sphere radius), below which there is no matter."""


class VoxelVolume:
    """Extinction inside the unit sphere, a :class:`mi_ntf.infer.grid.Density`.

    Parameters
    ----------
    values
        (z, y, x) float32: extinction at the centres of the voxels, 1/(unit-sphere radius).
    low, high
        Corners of the box that the voxels fill, field coordinates.
    body
        Body outside of which there is no matter.
    hull
        (k, 3) points whose convex hull holds all matter.
    dj
        Dr.Jit module of the back end.

    Notes
    -----
    The voxels may have another length along each axis, so points are scaled to the cubic voxels of the bricks.
    """

    def __init__(self, values: np.ndarray, low: np.ndarray, high: np.ndarray, body: Convex, hull: np.ndarray,
                 dj: ModuleType):
        self.body, self.hull, self._dj = body, hull, dj
        self._bricks = bricks.Bricks(bricks.of_dense(values[..., None], values > FAINTEST), dj)
        self.bounds = hull.min(0), hull.max(0)
        self.majorant, self.gloss = float(values.max(initial=0.0)), 0.0
        counts, cells = np.array(values.shape[::-1], np.float64), self._bricks.resolution
        size = np.asarray(high, np.float64) - low
        self.resolution = int(np.ceil((2 * counts / size).max()))
        scale = 2 * counts / (cells * size)
        offset, last = -1 - scale * low, (counts - 0.5) * 2 / cells - 1
        self._scale, self._offset, self._last, self._inverse = (
            tuple(dr.opaque(dj.Float, float(v)) for v in row) for row in (scale, offset, last, 1 / scale))
        digest = hashlib.sha256(np.ascontiguousarray(values).data)
        for array in (low, high, body.planes, np.array([body.radius or 0.0]), hull):
            digest.update(np.ascontiguousarray(array, np.float64).data)
        self.digest = digest.hexdigest()

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self._bricks.nbytes

    def density(self, p: Vector) -> Float:
        """Return σ at `p`, 1/(unit-sphere radius)."""
        return density_of(self.log_density(self.place(p)))

    def reflectance(self, p: Vector) -> Reflected:
        """Return no normal, a white albedo, roughness 1 and no specular lobe: a medium has a phase function."""
        zero, one = dr.zeros(type(p[0]), dr.width(p[0])), dr.ones(type(p[0]), dr.width(p[0]))
        return (zero, zero, zero), (one, one, one), one, zero

    def place(self, p: Vector) -> Place:
        """Return the places of `p` in the bricks, and a mask of the points inside the body."""
        scaled = tuple(ops.fmin(dr.fma(c, s, o), last) for c, s, o, last in zip(
            p, self._scale, self._offset, self._last, strict=True))
        return *self._bricks.place(scaled), self.body.inside(p)

    def log_density(self, place: Place) -> Float:
        """Return ln σ at a place, ``NOTHING`` outside the body."""
        sigma = self._bricks.at(place[:-1])[0]
        return dr.select(place[-1] & (sigma > FAINTEST), dr.log(sigma), NOTHING)

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs through empty bricks."""
        return self._bricks.clear_distance(place[:-1], tuple(
            i * s for i, s in zip(inverse_d, self._inverse, strict=True)))

    def extent(self, m: Vector, d: Vector, h: Float) -> tuple[Float, Float]:
        """Return begin and end, t', of the part of a chord inside the body (:meth:`Convex.extent`)."""
        return self.body.extent(m, d, h)
