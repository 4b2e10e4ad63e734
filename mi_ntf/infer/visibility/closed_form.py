"""Transmittance of a homogeneous medium in a convex body, where no march and no lookup is needed."""

from types import ModuleType

import drjit as dr

from ...core import spheres
from .. import ops
from ..grid import Density
from ..types import Float, Mask, UInt32, Vector


class ClosedForm:
    """A visibility method: e^(−σ s), where a ray has the length s inside `volume`, of constant extinction σ.

    `sigma`: in 1/(unit-sphere radius).
    """

    def __init__(self, volume: Density, sigma: float, dj: ModuleType):
        self.volume, self._sigma = volume, dr.opaque(dj.Float, sigma)

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the transmittance from `x` to the light."""
        hit, m, h = spheres.chord(ops, x, wi)
        here = spheres.coordinate(x, wi)
        begin, end = self.volume.extent(m, wi, h)
        length = dr.minimum(here + distance, end) - dr.maximum(here, begin)
        return dr.exp(-self._sigma * dr.select(hit, dr.maximum(length, 0), 0))
