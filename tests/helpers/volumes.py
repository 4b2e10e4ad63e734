"""Volumes whose density is a formula, and the voxels of baked ones."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.infer.grid import InSphere
from mi_ntf.infer.network import NOTHING


class Formula(InSphere):
    """A :class:`mi_ntf.infer.grid.Density` of the density `density`, without any empty space."""

    def __init__(self, density, hull=None):
        self.density, self.hull = density, hull

    def place(self, p):
        return (tuple(mi.Float(c) for c in p),)

    def log_density(self, place):
        sigma = mi.Float(self.density(place[0]))
        return dr.select(sigma > 0, dr.log(sigma), NOTHING)

    def clear_distance(self, place, inverse_d):
        return dr.zeros(mi.Float, dr.width(place))


class Unskipped(Formula):
    """The `volume` without its empty space."""

    def __init__(self, volume):
        super().__init__(volume.density, volume.hull)
        self.place, self.log_density, self.extent = volume.place, volume.log_density, volume.extent

    def clear_distance(self, place, inverse_d):
        return 0 * self.density(tuple(place[:3]))


def voxels(bricks) -> np.ndarray:
    """Values at the centres of the voxels, (z, y, x, channels)."""
    n = bricks.resolution
    axis = mi.Float(((np.arange(n) + 0.5) * (2 / n) - 1).astype(np.float32))
    z, y, x = dr.meshgrid(axis, axis, axis, indexing="ij")
    found = bricks.at(bricks.place((x, y, z)))
    return np.stack([np.array(channel) for channel in found], 1).reshape(n, n, n, -1)
