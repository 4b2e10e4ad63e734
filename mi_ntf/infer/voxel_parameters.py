"""Density and reflectance of a field as numbers that a user sets: values at voxels, with their gradients."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from types import ModuleType

import drjit as dr
import numpy as np

from ..core.architecture import LOG_FLOOR
from ..core.microfacet import MIN_ROUGHNESS
from .bake import REFLECTANCE_RESOLUTION
from .blocks import VOXELS, Blocks
from .bricks import NUMBER, OCTANTS, SIDE, any_between, bricks_per_side, octants_with_matter
from .grid import GridField, PlacedVoxels
from .network import LOG_MIN_DENSITY, NOTHING, coloured
from .refined import changed
from .types import Float, Reflected, Vector
from .volume import FAINTEST, SPECULAR, VoxelVolume, hull_of

CHANNELS = {"normal": 3, "albedo": 3, "roughness": 1, "specular": 3}
"""Name → number of channels of each quantity of a reflectance, in the order of a field's voxels."""


@dataclass
class Lattice:
    """Blocks of voxels and their places in a field.

    ``place`` (scale, offset) converts field coordinates, by axis, to voxels from the first centre.
    """

    blocks: Blocks
    counts: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    dj: ModuleType

    def voxels(self, p: Vector) -> list[Float]:
        """Return the places of the field points `p` in voxels, clipped to the voxels."""
        return [dr.clip(c * dr.opaque(self.dj.Float, float(s)) + dr.opaque(self.dj.Float, float(o)), 0, float(n - 1))
                for c, s, o, n in zip(p, self.scale, self.offset, self.counts, strict=True)]

    def centres(self) -> Vector:
        """Return the field coordinates of all voxels."""
        return tuple((self.dj.Float(v) - float(o)) / float(s)
                     for v, o, s in zip(self.blocks.voxels(), self.offset, self.scale, strict=True))


@dataclass
class Corrections:
    """Changes of a reflectance: differences at voxels from the field's own values, trilinear between them."""

    lattice: Lattice
    values: dict[str, Float] = field(default_factory=dict)

    def apply(self, reflected: Reflected, p: Vector) -> Reflected:
        """Return `reflected`, the field's own reflectance at `p`, with the changes."""
        place = self.lattice.voxels(p)
        change = {name: self.lattice.blocks.at(values, CHANNELS[name], place) for name, values in self.values.items()}
        return changed(reflected, change)


class VoxelParameters:
    """Density and reflectance of `grid` at voxels, as a user may set them.

    Parameters
    ----------
    grid
        The field as it was read. It does not change.
    colour_alone
        The field is smoke or emits light, so that its colour is its whole reflectance.
    unit
        Length of a field unit, in which the ``density`` of a field of voxels is an inverse length.
    dj
        Dr.Jit module of the back end.

    Attributes
    ----------
    density_name, density, density_lattice
        ``log_density`` or ``density``, whichever marches interpolate; its values, and their places.
    reflectance, reflectance_lattice
        Name → values, and their places.

    Notes
    -----
    Values are expressions that nothing evaluates before somebody reads or changes them.
    """

    def __init__(self, grid: GridField | VoxelVolume, colour_alone: bool, unit: float, dj: ModuleType):
        self._grid, self._dj = grid, dj
        self._corners: np.ndarray | None = None
        self._linear = isinstance(grid, VoxelVolume)
        self._unit = unit if self._linear else 1.0
        self.density_name = "density" if self._linear else "log_density"
        self.density_lattice = _lattice(grid.density_voxels, dj)
        (stored,) = self.density_lattice.blocks.unpacked(grid.density_voxels.content)
        self.density: Float = stored / self._unit if self._linear else stored
        self.reflectance_lattice, values = self._own_reflectance()
        self._original = {name: value for name, value in values.items() if name == "albedo" or not colour_alone}
        self.reflectance = dict(self._original)

    def _own_reflectance(self) -> tuple[Lattice, dict[str, Float]]:
        """Return the lattice of the reflectance, and its values."""
        grid, dj = self._grid, self._dj
        voxels = grid.reflectance_voxels
        if voxels is not None:
            lattice = _lattice(voxels, dj)
            channels = lattice.blocks.unpacked(voxels.content)
            if len(channels) == 3:
                return lattice, {"albedo": _interleaved(channels)}
            channels = [*channels[:SPECULAR], *coloured(channels[SPECULAR:])]
        elif isinstance(grid, VoxelVolume):
            lattice = self.density_lattice
            uniform = grid.reflectance((dr.zeros(dj.Float, lattice.blocks.count * VOXELS),) * 3)[1]
            return lattice, {"albedo": _interleaved(list(uniform))}
        else:
            lattice = _coarse(grid, dj)
            normal, albedo, roughness, specular = grid.reflectance(lattice.centres())
            channels = [*normal, *albedo, roughness, *specular]
        ends = np.cumsum(list(CHANNELS.values()))
        return lattice, {name: _interleaved(channels[end - count : end])
                         for (name, count), end in zip(CHANNELS.items(), ends, strict=True)}

    def changed_grid(self) -> GridField | VoxelVolume:
        """Return the field with the present density."""
        values = dr.detach(self.density) * self._unit
        least, empty = (FAINTEST, 0.0) if self._linear else (LOG_MIN_DENSITY, LOG_FLOOR)
        voxels = self._grid.density_voxels
        content = self.density_lattice.blocks.repacked(voxels.content, values, least, empty)
        highest = float(dr.max(values)[0])
        return self._grid.with_density(content, highest if self._linear else float(np.exp(highest)), self._hull())

    def _hull(self) -> np.ndarray:
        """Return points whose convex hull holds all bricks, in which any density has its matter."""
        if self._corners is None:
            voxels = self._grid.density_voxels
            index = voxels.content.index.numpy().reshape((voxels.content.side,) * 3)
            full = np.where(index & np.uint32(NUMBER), index | np.uint32(0xFF << OCTANTS), index)
            self._corners = hull_of(full, voxels.counts, voxels.low, voxels.high)
        return self._corners

    def log_density(self, p: Vector) -> Float:
        """Return ln σ at the field points `p`, with the gradients of the values and of `p`."""
        place = self.density_lattice.voxels(p)
        (value,) = self.density_lattice.blocks.at(self.density, 1, place)
        if not self._linear:
            return value
        sigma = value * self._unit
        return dr.select(sigma > FAINTEST, dr.log(dr.maximum(sigma, FAINTEST)), NOTHING)

    def corrections(self, names: Iterable[str]) -> Corrections:
        """Return the changes of the reflectance by the values `names`."""
        return Corrections(self.reflectance_lattice,
                           {name: self.reflectance[name] - self._original[name] for name in names})

    def gloss(self) -> float:
        """Return the highest specular lobe, s/(4 α²), at a voxel."""
        roughness = dr.maximum(dr.detach(self.reflectance["roughness"]), MIN_ROUGHNESS)
        return float(dr.max(dr.detach(self.reflectance["specular"]) / (4 * dr.repeat(roughness, 3) ** 4))[0])


def _lattice(voxels: PlacedVoxels, dj: ModuleType) -> Lattice:
    """Return the voxels of bricks as numbers of their own."""
    side, size = voxels.content.side, voxels.high - voxels.low
    index = voxels.content.index.numpy().reshape((side,) * 3)
    scale = voxels.counts / size
    return Lattice(Blocks((index & np.uint32(NUMBER)) > 0, voxels.counts, dj), voxels.counts, scale,
                   -voxels.low * scale - 0.5, dj)


def _coarse(grid: GridField, dj: ModuleType) -> Lattice:
    """Return voxels around the matter of a field whose reflectance has none, since networks give it."""
    fine, n = grid.resolution, min(grid.resolution, REFLECTANCE_RESOLUTION)
    side = grid.bricks.side
    octants = octants_with_matter(grid.bricks.index.numpy().reshape((side,) * 3))
    first = SIDE * np.arange(bricks_per_side(n))
    # In octants of the density's bricks; an octant at either side more covers rounding.
    low, high = (((first + k + 0.5) * fine / n - 0.5) / (SIDE // 2) for k in (0, SIDE))
    low, high = (np.clip(np.floor(v).astype(int) + k, 0, 2 * side - 1) for v, k in ((low, -1), (high, 1)))
    counts = np.full(3, n)
    return Lattice(Blocks(any_between(octants, low, high), counts, dj), counts, counts / 2, counts / 2 - 0.5, dj)


def _interleaved(channels: Sequence[Float]) -> Float:
    """Return channels of one width as one array, the channels of a voxel side by side."""
    if len(channels) == 1:
        return channels[0]
    floats = type(channels[0])
    return dr.ravel(getattr(importlib.import_module(floats.__module__), f"Array{len(channels)}f")(*channels))
