"""Reader of `transforms_<split>.json`: our captures, NeRF-synthetic (Blender) and NRHints.

All three are one format; they differ in what may be missing:

    camera         `camera_angle_x` (radians), or NRHints' `camera_intrinsics` [cx, cy, fx, fy] (pixels)
    w, h           found from the images
    file_path      with or without extension; NRHints names it in `file_ext`
    pl_pos         x, y, z or x, y, z, 1; missing: the light is at the camera
    pl_intensity   one number or RGB; missing: estimated
    unit_sphere    missing: found

Source of the two foreign dialects: the public loaders of NeRF (Mildenhall et al. 2020) and of NRHints (Zeng et al.
2023).
"""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import json_entries as entries
from mi_ntf.data.schema import SPLITS, Camera, Found, View


def read(folder: Path) -> Found:
    """Read every split that `folder` has; `train` must be there. Raises MiNtfError."""
    views, spheres, notes = {}, {}, []
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if split == "train" or path.is_file():
            data, assumed = entries.load(path)
            views[split], spheres[split] = _split(data, folder, path)
            notes += assumed
    given = {split: sphere for split, sphere in spheres.items() if sphere is not None}
    sphere = given.get("train") or next(iter(given.values()), None)
    for split, (center, radius) in given.items():
        assert sphere is not None  # it is one of them
        if not (np.allclose(center, sphere[0], atol=1e-6 * sphere[1]) and np.isclose(radius, sphere[1])):
            raise MiNtfError(f"{folder / f'transforms_{split}.json'}: 'unit_sphere' is {center.tolist()}, {radius:g}, "
                             f"another split says {sphere[0].tolist()}, {sphere[1]:g}; all splits show one object: "
                             "write the same sphere")
    return Found(_dialect(views["train"], sphere), views, sphere, assumed=notes)


def _dialect(views: list[View], sphere: tuple[np.ndarray, float] | None) -> str:
    """Return the name of the data set's form, judged by its entries."""
    if sphere is not None:
        return "photographs of `mi-ntf capture`"
    if any(isinstance(view.camera, Camera) or view.light_pos is not None for view in views):
        return "NRHints data set"
    return "NeRF-synthetic (Blender) data set"


def _split(data: dict, folder: Path, path: Path) -> tuple[list[View], tuple[np.ndarray, float] | None]:
    """``(views, sphere or None)`` of one file's contents."""
    camera, size = _camera(data, str(path)), entries.size(data, str(path))
    views = [entries.view(entry, f"{path}, frame {i}", folder, camera, size) for i, entry in enumerate(data["frames"])]
    return views, entries.unit_sphere(data, path)


def _camera(data: dict, where: str) -> Camera | float:
    """The camera of a split."""
    if "camera_intrinsics" not in data:
        return entries.angle_x(data, where)
    cx, cy, fx, fy = map(float, entries.numbers(data, "camera_intrinsics", (4,), where))
    if min(fx, fy) <= 0:
        raise MiNtfError(f"{where}: 'camera_intrinsics' is {data['camera_intrinsics']}; the focal lengths, its "
                         "last two numbers [cx, cy, fx, fy], must be positive")
    return Camera(fx, fy, cx, cy)
