"""`mi-ntf export` to a grid: a field's extinction as a ``.vol`` or ``.vdb`` file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ntf.core import field_file, progress, voxels
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import grids, vdb
from mi_ntf.infer import bricks
from mi_ntf.infer.backend import module
from mi_ntf.infer.bake import at_voxels
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.surface import RESOLUTIONS

SUFFIXES = (".vol", ".vdb")
WRITERS = {".vol": grids.write_vol, ".vdb": vdb.write}


@dataclass(frozen=True)
class GridFile:
    """Figures of a grid: voxels along x, y and z, and the largest extinction, 1/scene unit."""

    file: str
    voxels: list[int]
    extinction: float


def export(field: Path, output: Path, resolution: int = 256) -> GridFile:
    """Write the extinction of a field file, 1/scene unit, as a grid in the format of `output`'s suffix.

    A field of voxels keeps its voxels. A trained one is sampled at `resolution` voxels per side of its sphere's box.
    Raises MiNtfError if an argument is out of range, or a library is missing.
    """
    if not RESOLUTIONS[0] <= resolution <= RESOLUTIONS[1]:
        raise MiNtfError(f"--resolution is {resolution}, expected {RESOLUTIONS[0]} to {RESOLUTIONS[1]} voxels per side")
    if output.suffix.lower() == ".vdb":
        vdb.module()
    with progress.Stage(f"making {output}") as stage:
        header = field_file.load_header(field)
        if isinstance(header, voxels.Voxels):
            arrays = voxels.load(field, header)
            density = bricks.to_dense({name: arrays[f"density.{name}"] for name in voxels.ARRAYS}, header.counts)
            bounds = np.array([header.low, header.high])
        else:
            dj, sphere = module("llvm_ad_rgb"), header.similarity
            network = NetworkField(*field_file.load(field), dj)
            density = at_voxels(lambda p: [network.density(p)], 1, None, resolution, dj, stage.update).reshape(
                (resolution,) * 3) / np.float32(sphere.radius)
            bounds = np.array(sphere.center) + sphere.radius * np.array([[-1.0], [1.0]])
        WRITERS[output.suffix.lower()](output, density, bounds)
    return GridFile(str(output), list(density.shape[::-1]), float(density.max()))


def print_summary(grid: GridFile) -> None:
    """Print the file, the figures of the grid, and the use of it."""
    print(f"grid: {grid.file} ({' × '.join(map(str, grid.voxels))} voxels)",
          f"extinction: up to {grid.extinction:.4g} per scene unit",
          "next: a heterogeneous medium of Mitsuba reads a .vol file with gridvolume, use_grid_bbox=true", sep="\n")
