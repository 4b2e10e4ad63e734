"""Parameters of an ``nrf`` medium under ``mi.traverse``."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer.backend import module_of
from ...infer.bricks import SIDE
from ...infer.grid import GridField
from ...infer.types import Array, Float, Reflected, Vector
from ...infer.volume import VoxelVolume
from ...infer.voxel_parameters import CHANNELS, Lattice, VoxelParameters
from .loaded import LoadedField

_changes = itertools.count(1)
"""Numbers of values that were set, in place of a hash of all voxels."""


class FieldParameters:
    """Density and reflectance of a field at voxels, as tensors that a user reads, sets and differentiates.

    Parameters
    ----------
    field
        The field as it was read.

    Attributes
    ----------
    field
        The field with the values that were set.
    """

    def __init__(self, field: LoadedField) -> None:
        self._read, dj = field, module_of(mi.Float)
        self.field: LoadedField = field
        colour_alone = field.phase is not None or field.emissive
        self.voxels = voxels = VoxelParameters(field.grid, colour_alone, field.similarity.radius, dj)
        self._names = {("emission" if field.emissive else name): name for name in voxels.reflectance}
        self._set: set[str] = set()
        self.tensors: dict[str, Array] = {
            voxels.density_name: _tensor(voxels.density, voxels.density_lattice, 1),
            **{shown: _tensor(voxels.reflectance[name], voxels.reflectance_lattice, CHANNELS[name])
               for shown, name in self._names.items()}}
        self._places = {"density_blocks": _places(voxels.density_lattice),
                        "reflectance_blocks": _places(voxels.reflectance_lattice)}

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Show the parameters."""
        for name, tensor in self.tensors.items():
            jump = mi.ParamFlags.Discontinuous if name == "normal" else 0
            callback.put(name, tensor, mi.ParamFlags.Differentiable | jump)
        for name, tensor in self._places.items():
            callback.put(name, tensor, mi.ParamFlags.NonDifferentiable | mi.ParamFlags.ReadOnly)

    def changed(self, keys: Sequence[str]) -> bool:
        """Take over the tensors called `keys`; return True if any of them is a parameter of the field."""
        mine = [key for key in self.tensors if key in keys]
        voxels, grid, digest, density_set = self.voxels, self.field.grid, self.field.digest, self.field.density_set
        for key in mine:
            tensor = self.tensors[key]
            if key == voxels.density_name:
                expected = voxels.density_lattice, 1
            else:
                expected = voxels.reflectance_lattice, CHANNELS[self._names[key]]
            shape = _shape(*expected)
            if tensor.shape != shape:
                raise MiNtfError(f"nrf medium: {key} was set to a tensor of shape {tensor.shape}, expected {shape}")
            if key == voxels.density_name:
                voxels.density = tensor.array
                grid = voxels.changed_grid()
                digest, density_set = f"{self._read.digest} changed {next(_changes)}", True
            else:
                voxels.reflectance[self._names[key]] = tensor.array
                self._set.add(self._names[key])
        if self._set & {"roughness", "specular"}:
            grid = _with_gloss(grid, voxels.gloss())
        if mine:
            self.field = replace(self._read, grid=grid, digest=digest, density_set=density_set,
                                 appearance=f"{self._read.digest} changed {next(_changes)}")
        return bool(mine)

    def reflectance(self, source: GridField | VoxelVolume) -> Reflecting:
        """Return the reflectance with the values that were set."""
        return Reflecting(source, self, frozenset(self._set))

    def attached(self) -> list[str]:
        """Return the names of the parameters that carry gradients."""
        return [name for name, tensor in self.tensors.items() if dr.grad_enabled(tensor)]

    @property
    def log_density(self) -> Callable[[Vector], Float] | None:
        """Function of field points to ln σ that carries the gradients of the density; None if it has none."""
        return self.voxels.log_density if dr.grad_enabled(self.tensors[self.voxels.density_name]) else None


class Reflecting:
    """Reflectance of field points, with values that were set."""

    def __init__(self, source: GridField | VoxelVolume, parameters: FieldParameters, names: frozenset[str]) -> None:
        self._source, self._changes = source, parameters.voxels.corrections(sorted(names)) if names else None

    def reflectance(self, p: Vector) -> Reflected:
        """Return normal, albedo, roughness and specular weight at `p`."""
        own = self._source.reflectance(p)
        return self._changes.apply(own, p) if self._changes else own


def _with_gloss(grid: GridField | VoxelVolume, gloss: float) -> GridField | VoxelVolume:
    result: GridField | VoxelVolume = copy.copy(grid)
    result.gloss = gloss
    return result


def _shape(lattice: Lattice, channels: int) -> tuple[int, ...]:
    """Return the shape of a tensor of values: blocks, z, y and x within a block, and channels if there are several."""
    return (lattice.blocks.count, SIDE, SIDE, SIDE) + ((channels,) if channels > 1 else ())


def _tensor(values: Float, lattice: Lattice, channels: int) -> Array:
    tensor: Array = mi.TensorXf(values, _shape(lattice, channels))
    return tensor


def _places(lattice: Lattice) -> Array:
    """Return the places of the blocks (k, 3), x first, in blocks."""
    tensor: Array = mi.TensorXu
    return tensor(np.ascontiguousarray(lattice.blocks.places.astype(np.uint32)))
