"""OpenVDB files, where OpenVDB's own Python module is installed.

Its grids have x first, and a voxel's centre has whole coordinates in the index space.
"""

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError, shown

PREFERRED = "density"
"""Name of the grid that is read if a file has several."""
MOST_VOXELS = 1 << 30
"""Largest number of voxels in the box of a grid."""


def module() -> ModuleType:
    """Return OpenVDB's module. Raises MiNtfError if there is none, or one that was made for another NumPy."""
    for name in ("openvdb", "pyopenvdb", "bpy"):
        try:
            vdb = importlib.import_module(name)
            if name == "bpy":  # which brings a folder of other modules without adding it to the path
                version = Path(str(vdb.__file__)).parents[3]
                sys.path += map(str, version.glob("python/lib/python*/site-packages"))
                vdb = importlib.import_module("openvdb")
        except ImportError:
            continue
        try:
            vdb.FloatGrid().copyFromArray(np.zeros((1, 1, 1), np.float32))
        except Exception as error:
            raise MiNtfError(f"OpenVDB's module {vdb.__name__} cannot read arrays of NumPy {np.__version__} "
                             f"({shown(error)}); install one that was made for this NumPy, or an older NumPy, or save "
                             "the grid as .vol or .npz") from None
        return vdb
    raise MiNtfError("a .vdb file needs OpenVDB's Python module, and there is none; install Debian's python3-openvdb "
                     "or `pip install bpy`, or save the grid as .vol or .npz")


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the density (z, y, x) and the box (2, 3) of a file's grid ``density``, or of its only grid of numbers."""
    vdb = module()
    try:
        grids = {grid.name: grid for grid in vdb.readAllGridMetadata(str(path)) if grid.valueTypeName in (
            "float", "half", "double") and grid.gridClass != vdb.GridClass.LEVEL_SET}
        name = PREFERRED if PREFERRED in grids else next(iter(grids)) if len(grids) == 1 else None
        grid = None if name is None else vdb.read(str(path), name)
    except Exception as error:  # OpenVDB's errors have no type of their own
        raise MiNtfError(f"{path} is no OpenVDB file or is damaged ({' '.join(str(error).split())[:120]}); write it "
                         "anew") from None
    if grid is None:
        raise MiNtfError(f"{path} has the grids of numbers {shown(', '.join(grids))} apart from level sets, none of "
                         f"which is called {PREFERRED}; name one so, or convert a level set to a fog volume")
    return _values(grid, path)


def _values(grid: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:
    first, last = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    first, last = first - 1, last + 1  # between active voxels and the background, values are interpolated
    counts = last - first + 1
    if (counts < 3).any() or np.prod(counts.astype(float)) > MOST_VOXELS:
        raise MiNtfError(f"{path} has no active voxels, or more than {MOST_VOXELS} in their box; crop the grid")
    values = np.zeros(counts, np.float32)
    grid.copyToArray(values, ijk=tuple(int(c) for c in first))
    corners = [np.array(grid.transform.indexToWorld(tuple(corner)), np.float64) for corner in (first - 0.5, last + 0.5)]
    low, high = np.minimum(*corners), np.maximum(*corners)
    across = [np.array(grid.transform.indexToWorld(tuple(np.eye(3)[axis])), np.float64)
              - grid.transform.indexToWorld((0.0, 0.0, 0.0)) for axis in range(3)]
    if np.abs(np.stack(across) - np.diag(np.diag(across))).max() > 1e-6 * np.abs(across).max():
        raise MiNtfError(f"{path} has a transform that turns or shears the voxels; resample the grid without it")
    for axis in range(3):
        if across[axis][axis] < 0:
            values = np.flip(values, axis)
    return values.transpose(2, 1, 0), np.stack([low, high])


def write(path: Path, density: np.ndarray, bounds: np.ndarray) -> None:
    """Write (z, y, x) as a grid ``density``; raise MiNtfError if that fails or the voxels are no cubes."""
    vdb = module()
    size = (bounds[1] - bounds[0]) / density.shape[::-1]
    if np.ptp(size) > 1e-4 * size.max():
        raise MiNtfError(f"the voxels of the field measure {' × '.join(f'{s:g}' for s in size)}, and OpenVDB's are "
                         "written as cubes; write a .vol file")
    grid = vdb.FloatGrid()
    grid.copyFromArray(np.ascontiguousarray(density.transpose(2, 1, 0)))
    grid.transform = vdb.createLinearTransform(voxelSize=float(size.mean()))
    move = getattr(grid.transform, "postTranslate", None) or grid.transform.translate  # older than OpenVDB 11
    move(tuple((bounds[0] + size / 2).tolist()))
    grid.name, grid.gridClass = PREFERRED, vdb.GridClass.FOG_VOLUME
    with files.replacing(path) as temporary:
        vdb.write(str(temporary), grids=[grid])
