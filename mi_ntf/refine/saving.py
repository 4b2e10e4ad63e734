"""Writing a field whose voxels were refined."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core import field_file
from ..core import voxels as voxel_file
from ..core.field_file import REFINED_CHANNELS
from ..core.json_values import Json
from ..infer.bricks import SIDE
from ..infer.refined import packed
from ..infer.volume import VoxelVolume
from ..infer.voxel_parameters import CHANNELS
from .subject import Subject

INVISIBLE = 1e-3
"""Difference of a reflectance up to which a voxel counts as unchanged."""


def save(subject: Subject, output: Path, record: Json) -> None:
    """Write the field of `subject` with its present reflectance.

    A trained field keeps its networks, and gets the differences at voxels (:mod:`mi_ntf.infer.refined`). A field of
    voxels gets other voxels. `record` is the entry ``refined`` of the provenance.
    """
    if isinstance(subject.medium.field.grid, VoxelVolume):
        _save_voxels(subject, output, record)
    else:
        _save_trained(subject, output, record)


def _save_trained(subject: Subject, output: Path, record: Json) -> None:
    lattice = subject.lattice("albedo")
    network = subject.original.network
    _, albedo, roughness, specular = network.learned_reflectance(lattice.centres())
    learned = {"albedo": albedo, "roughness": (roughness,), "specular": specular}
    parts = []
    for name, count in REFINED_CHANNELS.items():
        if subject.has(name):
            own = np.stack([np.array(v) for v in learned[name]], -1)
            parts.append(_voxels(subject, name, count) - own.reshape(-1, SIDE, SIDE, SIDE, count))
    if all(np.abs(part).max(initial=0.0) <= INVISIBLE for part in parts[1:]):
        parts = parts[:1]
    changes = {"reflectance": (lattice, np.concatenate(parts, -1)),
               "density": (subject.lattice("log_density"), _voxels(subject, "log_density", 1) - _own_density(subject))}
    arrays = {}
    for quantity, (lattice, values) in changes.items():
        visible = (np.abs(values) > INVISIBLE).any(-1)
        if visible.any():
            arrays[quantity] = packed(values, lattice.blocks.places, int(max(lattice.counts)), visible)
    field_file.add_refinement(subject.medium.path, output, arrays, record)


def _own_density(subject: Subject) -> np.ndarray:
    """Return ln σ of the networks at the voxels, without a refinement of the file."""
    lattice = subject.lattice("log_density")
    (stored,) = lattice.blocks.unpacked(subject.original.grid.density_voxels.content)
    refined = subject.original.network.refined_density
    own = stored - refined.at(lattice.centres())[0] if refined else stored
    result: np.ndarray = np.array(own).reshape(-1, SIDE, SIDE, SIDE, 1)
    return result


def _save_voxels(subject: Subject, output: Path, record: Json) -> None:
    path = subject.medium.path
    header = field_file.load_header(path)
    assert isinstance(header, voxel_file.Voxels)
    lattice = subject.lattice("density")
    values = _voxels(subject, "density", 1)
    density = packed(values, lattice.blocks.places, int(max(lattice.counts)))
    # The reflectance of a surface, or the colour of smoke.
    channels = CHANNELS if subject.has("normal") else {"emission" if header.emissive else "albedo": 3}
    values = np.concatenate([_voxels(subject, name, count) for name, count in channels.items()], -1)
    lattice = subject.lattice("albedo")
    reflectance = packed(values, lattice.blocks.places, int(max(lattice.counts)), np.ones(values.shape[:-1], bool))
    changed = replace(header, reflectance_counts=header.reflectance_counts or header.counts,
                      provenance=header.provenance | {"refined": record})
    voxel_file.save(output, changed, density, reflectance)


def _voxels(subject: Subject, name: str, channels: int) -> np.ndarray:
    values: np.ndarray = np.array(subject.get(name)).reshape(-1, SIDE, SIDE, SIDE, channels)
    return values
