"""Reader of `transforms_<split>.json`: our captures, NeRF-synthetic (Blender) and NRHints.

All three are one format; they differ in what may be missing:

    camera         `camera_angle_x` (radians), or NRHints' `camera_intrinsics` [cx, cy, fx, fy] (pixels)
    w, h           found from the images
    file_path      with or without extension; NRHints names it in `file_ext`
    pl_pos         missing: the light is at the camera. pl_intensity (one number or RGB) missing: estimated
    unit_sphere    missing: found

Source of the two foreign dialects: the public loaders of NeRF (Mildenhall et al. 2020) and of NRHints (Zeng et al.
2023).
"""

import json
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data.images import SUFFIXES, is_file_name, mask_places
from mi_ntf.data.poses import check_rigid
from mi_ntf.data.schema import SPLITS, Found, View


def read(folder: Path) -> Found:
    """Every split that `folder` has; `train` must be there. Raises MiNtfError."""
    views, spheres = {}, {}
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if split == "train" or path.is_file():
            views[split], spheres[split] = _read_split(folder, path)
    given = {split: sphere for split, sphere in spheres.items() if sphere is not None}
    sphere = given.get("train") or next(iter(given.values()), None)
    for split, (center, radius) in given.items():
        if not (np.allclose(center, sphere[0], atol=1e-6 * sphere[1]) and np.isclose(radius, sphere[1])):
            raise MiNtfError(f"{folder / f'transforms_{split}.json'}: 'unit_sphere' is {center.tolist()}, {radius:g}, "
                             f"another split says {sphere[0].tolist()}, {sphere[1]:g}; all splits show one object: "
                             "write the same sphere")
    return Found(views, sphere)


def _read_split(folder: Path, path: Path):
    """``(views, sphere or None)`` of one file."""
    try:
        data = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:  # also text that is not UTF-8
        raise MiNtfError(f"{path}: not valid JSON ({error}); the file is damaged, capture or copy it again") from None
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise MiNtfError(f"{path}: 'frames' is empty or missing; a split needs one photograph at least")
    camera, size = _camera(data, str(path)), None
    if "w" in data or "h" in data:
        size = (int(_positive(data, "w", str(path))), int(_positive(data, "h", str(path))))
    views = [_view(entry, f"{path}, frame {i}", folder, camera, size) for i, entry in enumerate(data["frames"])]
    sphere = None
    if "unit_sphere" in data:
        where = f"{path}, unit_sphere"
        sphere = _numbers(data["unit_sphere"], "center", (3,), where), _positive(data["unit_sphere"], "radius", where)
    return views, sphere


def _camera(data: dict, where: str) -> tuple[float, ...]:
    """The camera of a split as :class:`View` wants it."""
    if "camera_intrinsics" in data:
        cx, cy, fx, fy = _numbers(data, "camera_intrinsics", (4,), where)
        if min(fx, fy) <= 0:
            raise MiNtfError(f"{where}: 'camera_intrinsics' is {data['camera_intrinsics']}; the focal lengths, its "
                             "last two numbers [cx, cy, fx, fy], must be positive")
        return float(fx), float(fy), float(cx), float(cy)
    angle = _positive(data, "camera_angle_x", where)
    if angle >= np.pi:
        raise MiNtfError(f"{where}: 'camera_angle_x' is {angle:g}, must be below pi; it is in radians")
    return (angle,)


def _view(entry: dict, where: str, folder: Path, camera: tuple[float, ...], size) -> View:
    if not isinstance(entry, dict) or "file_path" not in entry:
        raise MiNtfError(f"{where}: 'file_path' is missing; name the image relative to the folder")
    c2w = _numbers(entry, "transform_matrix", (4, 4), where)
    check_rigid(c2w, where, "'transform_matrix'")
    position = _numbers(entry, "pl_pos", (3,), where) if "pl_pos" in entry else None
    intensity = None
    if "pl_intensity" in entry:
        shape = () if isinstance(entry["pl_intensity"], int | float) else (3,)
        intensity = np.broadcast_to(_numbers(entry, "pl_intensity", shape, where), (3,)).copy()
        if intensity.min() < 0 or intensity.max() <= 0:
            raise MiNtfError(f"{where}: 'pl_intensity' is {intensity.tolist()}, must be positive; leave it out in all "
                             "frames to have it estimated")
    name = _file_name(entry, "file_path", where)
    if Path(name).suffix.lower() not in SUFFIXES:
        told = _file_name(entry, "file_ext", where) if entry.get("file_ext") else None
        name = _with_suffix(folder, name, told, where)
    return View(where, folder / name, mask_places(folder, name), c2w, camera, size, position, intensity)


def _file_name(entry: dict, key: str, where: str) -> str:
    if not is_file_name(entry[key]):
        raise MiNtfError(f"{where}: '{key}' is {shown(entry[key])}, expected the name of a file")
    return entry[key]


def _with_suffix(folder: Path, name: str, told: str | None, where: str) -> str:
    """`name` with the extension of the file that exists. One that is named and not read is kept for its own error."""
    tried = [told] if told else [*SUFFIXES, ""]
    for suffix in tried:
        if (folder / f"{name}{suffix}").is_file():
            return f"{name}{suffix}"
    raise MiNtfError(f"{where}: {folder / name} does not exist with any of the extensions "
                     f"{' '.join(filter(None, tried))}; put the photograph there or take the frame out")


def _numbers(entry: dict, key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """The finite float array `entry[key]` of `shape` (float64), or a MiNtfError that begins with `where`."""
    if not isinstance(entry, dict) or key not in entry:
        raise MiNtfError(f"{where}: '{key}' is missing; see mi_ntf/data/schema.py for the format")
    try:
        value = np.array(entry[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise MiNtfError(f"{where}: '{key}' is {shown(entry[key])}, expected numbers of shape {shape}") from None
    if value.shape != shape:
        raise MiNtfError(f"{where}: '{key}' has shape {value.shape}, expected {shape}; write it as nested lists")
    if not (np.abs(value) < 1e30).all():
        raise MiNtfError(f"{where}: '{key}' is not finite: {shown(value.tolist())}; correct the pose or light")
    return value


def _positive(entry: dict, key: str, where: str) -> float:
    value = float(_numbers(entry, key, (), where))
    if not 1e-12 < value < 1e12:
        raise MiNtfError(f"{where}: '{key}' is {value:g}, must be positive, from 1e-12 to 1e12")
    return value
