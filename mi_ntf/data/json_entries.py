"""Entries of `transforms*.json`, in whichever dialect: each is checked, and a fault names file, frame and value."""

import json
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import file_names, text
from mi_ntf.data.poses import check_rigid
from mi_ntf.data.schema import Camera, View


def load(path: Path) -> tuple[dict, list[str]]:
    """``(contents, what was assumed)`` of the file, which has `frames`. Raises MiNtfError."""
    try:
        written, assumed = text.read(path)
        data = json.loads(written)
    except (OSError, ValueError, RecursionError) as error:  # also half a character of UTF-16
        raise MiNtfError(f"{path}: not valid JSON ({error}); the file is damaged, capture or copy it again") from None
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise MiNtfError(f"{path}: 'frames' is empty or missing; a split needs one photograph at least")
    return data, [assumed] if assumed else []


def unit_sphere(data: dict, path: Path) -> tuple[np.ndarray, float] | None:
    """The object's sphere ``(center (3,), radius)``, if the file has one."""
    if "unit_sphere" not in data:
        return None
    where = f"{path}, unit_sphere"
    return numbers(data["unit_sphere"], "center", (3,), where), positive(data["unit_sphere"], "radius", where)


def size(data: dict, where: str) -> tuple[int, int] | None:
    """(width, height) in pixels, if the file has both."""
    if "w" not in data and "h" not in data:
        return None
    return int(positive(data, "w", where)), int(positive(data, "h", where))


def angle_x(data: dict, where: str) -> float:
    """The horizontal field of view, radians."""
    angle = positive(data, "camera_angle_x", where)
    if angle >= np.pi:
        raise MiNtfError(f"{where}: 'camera_angle_x' is {angle:g}, must be below pi; it is in radians")
    return angle


def view(entry: dict, where: str, folder: Path, camera: Camera | float, size: tuple[int, int] | None) -> View:
    """The photograph of one frame; `camera` and `size` are what its split or itself says."""
    if not isinstance(entry, dict) or "file_path" not in entry:
        raise MiNtfError(f"{where}: 'file_path' is missing; name the image relative to the folder")
    c2w = numbers(entry, "transform_matrix", (4, 4), where, also=(3, 4))
    c2w = np.vstack([c2w, np.eye(4)[len(c2w):]])
    check_rigid(c2w, where, "'transform_matrix'")
    intensity = None
    if "pl_intensity" in entry:
        shape = () if isinstance(entry["pl_intensity"], int | float) else (3,)
        intensity = np.broadcast_to(numbers(entry, "pl_intensity", shape, where), (3,)).copy()
        if intensity.min() < 0 or intensity.max() <= 0:
            raise MiNtfError(f"{where}: 'pl_intensity' is {intensity.tolist()}, must be positive; leave it out in all "
                             "frames to have it estimated")
    name = file_name(entry, "file_path", where)
    if Path(name).suffix.lower() not in file_names.SUFFIXES:
        told = file_name(entry, "file_ext", where) if entry.get("file_ext") else None
        name = _with_suffix(folder, name, told, where)
    image, name = file_names.locate(folder, name), file_names.plain(name)
    masks = file_names.mask_places(folder / "masks", name)
    return View(where, image, name, masks, c2w, camera, size, _position(entry, where), intensity)


def _position(entry: dict, where: str) -> np.ndarray | None:
    """The light's place (3,), also of homogeneous coordinates that end in 1."""
    if "pl_pos" not in entry:
        return None
    place = numbers(entry, "pl_pos", (3,), where, also=(4,))
    if len(place) == 4 and place[3] != 1:
        raise MiNtfError(f"{where}: 'pl_pos' has a fourth number, {place[3]:g}, which is 1 in homogeneous coordinates; "
                         "write x, y and z alone, and an intensity as 'pl_intensity'")
    return place[:3]


def file_name(entry: dict, key: str, where: str) -> str:
    """The name of a file at `entry[key]`."""
    if not file_names.is_file_name(entry[key]):
        raise MiNtfError(f"{where}: '{key}' is {shown(entry[key])}, expected the name of a file")
    return entry[key]


def _with_suffix(folder: Path, name: str, told: str | None, where: str) -> str:
    """`name` with the extension of the file that exists. One that is named and not read is kept for its own error."""
    tried = [f".{told.removeprefix('.')}"] if told else [*file_names.SUFFIXES, ""]
    for suffix in tried:
        for own in (name, file_names.plain(name)):
            found = file_names.on_disk(folder / f"{own}{suffix}")
            if found is not None:
                return f"{own}{found.suffix if suffix else ''}"
    raise MiNtfError(f"{where}: {folder / name} does not exist with any of the extensions "
                     f"{' '.join(filter(None, tried))}; put the photograph there or take the frame out")


def numbers(entry: dict, key: str, shape: tuple[int, ...], where: str, also: tuple[int, ...] | None = None
            ) -> np.ndarray:
    """The finite float array `entry[key]` (float64) of `shape`, or of the shape `also`. Raises MiNtfError, whose text
    begins with `where`."""
    if not isinstance(entry, dict) or key not in entry:
        raise MiNtfError(f"{where}: '{key}' is missing; write it there (what each form needs: mi_ntf/data/readers.py)")
    try:
        value = np.array(entry[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise MiNtfError(f"{where}: '{key}' is {shown(entry[key])}, expected numbers of shape {shape}") from None
    if value.shape not in (shape, also):
        raise MiNtfError(f"{where}: '{key}' has shape {value.shape}, expected {shape}; write it as nested lists")
    if not (np.abs(value) < 1e30).all():
        raise MiNtfError(f"{where}: '{key}' is not finite: {shown(value.tolist())}; correct the pose or light")
    return value


def positive(entry: dict, key: str, where: str) -> float:
    """The positive number `entry[key]`."""
    value = float(numbers(entry, key, (), where))
    if not 1e-12 < value < 1e12:
        raise MiNtfError(f"{where}: '{key}' is {value:g}, must be positive, from 1e-12 to 1e12")
    return value
