"""Reader of LLFF's `poses_bounds.npy` with its photographs in `images/`.

The file has one row of 17 numbers for each photograph, in the order of their names: a 3x5 matrix, row by row, and the
depths of the nearest and farthest point. The matrix has the camera's axes down, right and backward in the world, its
place, and (height, width, focal length) in pixels as columns. The principal point is the middle. Photographs may be
scaled copies.

Sources: "Using your own poses" in the documentation of LLFF (Mildenhall et al. 2019), and the loader of NeRF.
"""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data.file_names import mask_places, photographs
from mi_ntf.data.poses import check_rigid
from mi_ntf.data.schema import Camera, DataSet, View

FORM = "LLFF data set (poses_bounds.npy)"


def read(folder: Path) -> DataSet:
    """Read all photographs as one split, `train`. Raises MiNtfError."""
    path, images = folder / "poses_bounds.npy", folder / "images"
    try:
        stored = np.load(path, mmap_mode="r", allow_pickle=False)  # a wrong header then allocates no memory
    except Exception as error:  # NumPy raises many kinds for a damaged file
        raise MiNtfError(f"{path}: cannot be read as an array of NumPy ({shown(str(error))}); write it again with "
                         "LLFF's imgs2poses.py") from None
    if stored.ndim != 2 or stored.shape[1] != 17 or not len(stored) or stored.dtype.kind not in "fiu":
        raise MiNtfError(f"{path}: is an array of {stored.dtype} with shape {stored.shape}, expected numbers (N, 17); "
                         "write it again with LLFF's imgs2poses.py")
    with np.errstate(all="ignore"):  # `_view` reports infinity
        rows = np.array(stored, np.float64)
    if not images.is_dir():
        raise MiNtfError(f"{images} does not exist; put the photographs of {path} there")
    names = [path.name for path in photographs(images.iterdir())]
    if len(names) != len(rows):
        raise MiNtfError(f"{path}: has {len(rows)} poses, {images} has {len(names)} photographs; one belongs to each, "
                         "in the order of the names: take out the photographs that have no pose")
    return DataSet(FORM, {"train": [_view(row, f"{path}, row {i} ({name})", folder, name)
                                    for i, (row, name) in enumerate(zip(rows, names, strict=True))]})


def _view(row: np.ndarray, where: str, folder: Path, name: str) -> View:
    if not (np.abs(row[:15]) < 1e30).all():
        raise MiNtfError(f"{where}: is not finite: {shown(row[:15].tolist())}; run LLFF's imgs2poses.py again")
    down, right, backward, place, (height, width, focal) = row[:15].reshape(3, 5).T
    if not (min(height, width) >= 1 and max(height, width) < 1 << 20 and focal > 0):
        raise MiNtfError(f"{where}: its height, width and focal length are {[height, width, focal]}; they are pixels "
                         "and positive: run LLFF's imgs2poses.py again")
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, -down, backward, place], -1)
    check_rigid(c2w, where, "its pose")
    camera = Camera(focal, focal, 0.5 * width, 0.5 * height)
    return View(where, folder / "images" / name, name, mask_places(folder / "masks", name), c2w, camera,
                (round(width), round(height)), rescaled=True)
