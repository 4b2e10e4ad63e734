"""Densities that marches read: a field baked into bricks, or its networks with the bricks' empty space."""

import copy
from types import ModuleType
from typing import NamedTuple, Protocol

import drjit as dr
import numpy as np

from ..core.ops import normalize
from . import ops
from .bake import bake
from .bricks import Bricks
from .network import NOTHING, NetworkField, coloured, cut, density_of, inside
from .types import Float, Place, Reflected, Vector


class Density(Protocol):
    """Extinction inside the unit sphere, the interface of a medium for marches, maps and atlases.

    ``resolution``: voxels per side of its finest detail, for default step lengths.
    ``majorant``: upper bound of the density, 1/(unit-sphere radius).
    ``hull``: (k, 3) points whose convex hull holds all density; ``bounds``: its box, two (3,) corners.
    """

    resolution: int
    majorant: float
    hull: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]

    def density(self, p: Vector, /) -> Float:
        """Return σ at the points `p`, 1/(unit-sphere radius); 0 outside the unit sphere."""

    def reflectance(self, p: Vector, /) -> Reflected:
        """Return normal, albedo, roughness and specular weight at the points `p`."""

    def place(self, p: Vector, /) -> Place:
        """Return the work that `log_density` and `clear_distance` share at the points `p`."""

    def log_density(self, place: Place, /) -> Float:
        """Return ln σ at a :meth:`place` inside the unit sphere, ``NOTHING`` where there is none."""

    def clear_distance(self, place: Place, inverse_d: Vector, /) -> Float:
        """Return the distance from a :meth:`place` inside the sphere along which a ray meets no density, or 0.

        `inverse_d`: 1/direction by axis, finite.
        """

    def extent(self, m: Vector, d: Vector, h: Float, /) -> tuple[Float, Float]:
        """Return begin and end, t', of the part of the chord m + t' d, |t'| ≤ h, that may hold density."""


class PlacedVoxels(NamedTuple):
    """Bricks whose voxels, `counts` along x, y and z, fill the box from `low` to `high`, field coordinates."""

    content: Bricks
    counts: np.ndarray
    low: np.ndarray
    high: np.ndarray


class InSphere:
    """A density that fills the unit sphere."""

    def extent(self, m: Vector, d: Vector, h: Float) -> tuple[Float, Float]:
        """Return the ends of the whole chord."""
        return -h, h


class GridField(InSphere):
    """A field's density, trilinear ln σ between the voxels of :mod:`mi_ntf.infer.bake`, and its reflectance.

    Parameters
    ----------
    arrays
        Result of :func:`mi_ntf.infer.bake.bake`. Raises KeyError or ValueError if they cannot be that.
    field
        The networks, which give the reflectance if it costs no more than a few fetches: shading points are few beside
        the steps of marches, and voxels as fine as the networks' planes would take gigabytes.
    """

    def __init__(self, arrays: dict[str, np.ndarray], field: NetworkField, dj: ModuleType):
        self.dj, self._field = dj, field
        self.bricks = bricks_of(arrays, "density", dj)
        self.resolution = self.bricks.resolution
        self.place, self.clear_distance = self.bricks.place, self.bricks.clear_distance
        self._reflectance = None if field.quick else bricks_of(arrays, "reflectance", dj)
        self.majorant, self.gloss = map(float, arrays["numbers"])
        self.hull = arrays["hull"]
        channels = 8 if self._reflectance is None else self._reflectance.channels
        if self.hull.shape[1:] != (3,) or channels not in (8, 10) or not np.isfinite(self.hull).all():
            raise ValueError("these arrays are no baked field")
        self.bounds = self.hull.min(0), self.hull.max(0)

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self.bricks.nbytes + (self._reflectance.nbytes if self._reflectance else 0)

    @property
    def density_voxels(self) -> PlacedVoxels:
        """Voxels of ln σ."""
        return _in_cube(self.bricks)

    @property
    def reflectance_voxels(self) -> PlacedVoxels | None:
        """Voxels of the reflectance; None if the networks give it."""
        return _in_cube(self._reflectance) if self._reflectance else None

    def with_density(self, content: Bricks, majorant: float, hull: np.ndarray) -> "GridField":
        """Return a copy with other bricks of ln σ."""
        result = copy.copy(self)
        result.bricks, result.majorant, result.hull = content, majorant, hull
        result.bounds = hull.min(0), hull.max(0)
        result.place, result.clear_distance = content.place, content.clear_distance
        return result

    def density(self, p: Vector) -> Float:
        """Return σ at `p`, 1/(unit-sphere radius)."""
        return density_of(inside(self.log_density(self.place(p)), p))

    def log_density(self, place: Place) -> Float:
        """Return ln σ at a place, ``NOTHING`` where there is none."""
        return cut(self.bricks.at(place)[0])

    def reflectance(self, p: Vector) -> Reflected:
        """Return normal, albedo, roughness and specular weight at `p`."""
        if self._reflectance is None:
            return self._field.reflectance(p)
        v = self._reflectance.at(self._reflectance.place(p))
        return normalize(ops, tuple(v[:3])), tuple(v[3:6]), v[6], coloured(v[7:])


class NetworkVolume(InSphere):
    """The density and reflectance of the networks `field` themselves, in the empty space of `grid`."""

    def __init__(self, field: NetworkField, grid: GridField, majorant: float):
        self.density, self.reflectance, self.majorant = field.density, field.reflectance, majorant
        self.hull, self.bounds, self.resolution = grid.hull, grid.bounds, grid.resolution
        self._field, self._bricks = field, grid.bricks

    def place(self, p: Vector) -> Place:
        """Return the points and their places in the bricks."""
        return tuple(p), self._bricks.place(p)

    def log_density(self, place: Place) -> Float:
        """Return ln σ at a place, ``NOTHING`` where there is none and outside the bricks."""
        p, place = place
        return dr.select(self._bricks.occupied(place), cut(self._field.log_density(p)), NOTHING)

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs through empty bricks."""
        return self._bricks.clear_distance(place[1], inverse_d)


def _in_cube(content: Bricks) -> PlacedVoxels:
    """Return bricks of as many voxels along each axis, which fill the cube around the unit sphere."""
    return PlacedVoxels(content, np.full(3, content.resolution), np.full(3, -1.0), np.ones(3))


def bricks_of(arrays: dict[str, np.ndarray], name: str, dj: ModuleType) -> Bricks:
    """Return the bricks called `name` among the `arrays` of a baked field."""
    prefix = f"{name}."
    return Bricks({key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}, dj)


def baked(field: NetworkField, resolution: int, dj: ModuleType) -> GridField:
    """Return `field` baked at `resolution`³ voxels."""
    return GridField(bake(field, resolution, dj), field, dj)
