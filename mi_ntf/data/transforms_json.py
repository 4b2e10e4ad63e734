"""Readers of `transforms_<split>.json` (our captures, NeRF-synthetic, NRHints) and of nerfstudio's `transforms.json`.

:func:`read_splits` reads a file for each split. The camera is `camera_angle_x` (radians), or NRHints'
`camera_intrinsics` [cx, cy, fx, fy] (pixels). `file_path` may lack its extension, which NRHints names in `file_ext`.
`pl_pos` is x, y, z or x, y, z, 1; without it the light is at the camera. `pl_intensity` is one number or RGB. Missing
`w`, `h`, `pl_intensity` and `unit_sphere` are derived from the images.

:func:`read_nerfstudio` reads the file of nerfstudio and instant-ngp:

    fl_x, fl_y, cx, cy, w, h     pixels, for all frames or in each; (0, 0) is the corner of the top left pixel. Missing
                                 fl_y: fl_x; missing cx, cy: the middle; missing fl_x: `camera_angle_x` (radians)
    k1, k2, k3, p1, p2           lens distortion as OpenCV has it; k4 is another term than OpenCV's and must be 0
    camera_model                 OPENCV (also if missing), PINHOLE, SIMPLE_PINHOLE, RADIAL, SIMPLE_RADIAL
    frames                       file_path, transform_matrix (camera-to-world, OpenGL axes), mask_path (white: object)
    train_filenames, val_filenames, test_filenames    file_path of the frames of each split

Frames of nerfstudio without a photograph are dropped, as instant-ngp does. Every fault names file, frame and value.
Sources: the loaders of NeRF (Mildenhall et al. 2020) and NRHints (Zeng et al. 2023); nerfstudio's "Data conventions",
and for k4 its undistortion (`full_images_datamanager`), which refuses it as well.
"""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import file_names
from mi_ntf.data.estimates import Sphere
from mi_ntf.data.file_names import is_file_name, locate, plain
from mi_ntf.data.poses import check_rigid
from mi_ntf.data.schema import SPLITS, Camera, DataSet, View, focal_length

NERFSTUDIO = "nerfstudio data set (transforms.json)"
STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE")
MODELS = ("OPENCV", "RADIAL", "SIMPLE_RADIAL", *STRAIGHT)
DISTORTION = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order

Entries = dict[str, object]


def read_splits(folder: Path) -> DataSet:
    """Read every split that `folder` has; `train` must be there. Raises MiNtfError."""
    views: dict[str, list[View]] = {}
    spheres: dict[str, Sphere] = {}
    notes: list[str] = []
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if split == "train" or path.is_file():
            data, frames = _load(path, notes)
            camera, size = _intrinsics(data, str(path)), _size(data, str(path))
            views[split] = [_view(entry, f"{path}, frame {i}", folder, camera, size) for i, entry in enumerate(frames)]
            if (sphere := _sphere(data, path)) is not None:
                spheres[split] = sphere
    expected = spheres.get("train") or next(iter(spheres.values()), None)
    for split, (center, radius) in spheres.items():
        assert expected is not None
        if not (np.allclose(center, expected.center, atol=1e-6 * expected.radius) and np.isclose(radius, expected[1])):
            raise MiNtfError(f"{folder / f'transforms_{split}.json'}: 'unit_sphere' is {center.tolist()}, {radius:g}, "
                             f"another split says {expected.center.tolist()}, {expected.radius:g}; all splits show one "
                             "object: write the same sphere")
    if expected is not None:
        form = "photographs of `mi-ntf capture`"
    elif any(isinstance(view.camera, Camera) or view.light_pos is not None for view in views["train"]):
        form = "NRHints data set"
    else:
        form = "NeRF-synthetic (Blender) data set"
    return DataSet(form, views, expected, assumed=notes)


def read_nerfstudio(folder: Path) -> DataSet:
    """Read the splits that `transforms.json` names, or all its frames as `train`. Raises MiNtfError."""
    path = folder / "transforms.json"
    assumed: list[str] = []
    data, frames = _load(path, assumed)
    views = [_nerfstudio_view(data, entry, f"{path}, frame {i}", folder) for i, entry in enumerate(frames)]
    splits, notes = _named_splits(data, views, path)
    complete = {split: [view for view in chosen if view.image.is_file()] for split, chosen in splits.items()}
    count, existing = (sum(map(len, each.values())) for each in (splits, complete))
    if existing > count / 2 and complete["train"]:  # else it is the wrong folder, or a copy that was broken off
        splits = {split: chosen for split, chosen in complete.items() if chosen}
        notes += [f"{count - existing} of {count} frames have no photograph and are left out"] * (existing < count)
    return DataSet(NERFSTUDIO, splits, _sphere(data, path), None, notes, assumed)


def _load(path: Path, assumed: list[str]) -> tuple[Entries, list[object]]:
    """Return the contents of the file and its `frames`; assumptions about the text are added to `assumed`."""
    try:
        text, note = file_names.read_text(path)
        data = json.loads(text)
    except (OSError, ValueError, RecursionError) as error:  # also half a character of UTF-16
        raise MiNtfError(f"{path}: not valid JSON ({error}); the file is damaged, capture or copy it again") from None
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise MiNtfError(f"{path}: 'frames' is empty or missing; a split needs one photograph at least")
    assumed += [note] if note else []
    return data, data["frames"]


def _intrinsics(data: Entries, where: str) -> Camera | float:
    if "camera_intrinsics" not in data:
        return _angle_x(data, where)
    cx, cy, fx, fy = map(float, _numbers(data, "camera_intrinsics", (4,), where))
    if min(fx, fy) <= 0:
        raise MiNtfError(f"{where}: 'camera_intrinsics' is {data['camera_intrinsics']}; the focal lengths, its "
                         "last two numbers [cx, cy, fx, fy], must be positive")
    return Camera(fx, fy, cx, cy)


def _nerfstudio_camera(entries: Entries, where: str) -> Camera | float:
    """Return the camera of the entries of a frame and of its file."""
    fisheye = " (is_fisheye)" if entries.get("is_fisheye") else ""
    model = entries.get("camera_model", "OPENCV")
    if model not in MODELS or fisheye:
        raise MiNtfError(f"{where}: its 'camera_model' is {shown(model)}{fisheye}; read are {', '.join(MODELS)}: "
                         "undistort the photographs first, for example with `colmap image_undistorter`, and train on "
                         "its output")
    bent = () if model in STRAIGHT else tuple(_number(entries, key, where) for key in DISTORTION)
    if bent and _number(entries, "k4", where):
        raise MiNtfError(f"{where}: 'k4' is {entries['k4']}; that term is not undone: calibrate with k1 to k3, p1 and "
                         "p2 alone, or undistort the photographs first")
    bent = bent if any(bent) else ()
    if "fl_x" in entries:
        fx = _positive(entries, "fl_x", where)
    elif bent or "cx" in entries or "cy" in entries:
        fx = focal_length(_angle_x(entries, where), _positive(entries, "w", where))
    else:
        return _angle_x(entries, where)
    fy = _positive(entries, "fl_y", where) if "fl_y" in entries else fx
    cx, cy = (_number(entries, key, where) if key in entries else 0.5 * _positive(entries, side, where)
              for key, side in (("cx", "w"), ("cy", "h")))
    return Camera(fx, fy, cx, cy, bent)


def _angle_x(entries: Entries, where: str) -> float:
    """Return the horizontal field of view in radians."""
    angle = _positive(entries, "camera_angle_x", where)
    if angle >= np.pi:
        raise MiNtfError(f"{where}: 'camera_angle_x' is {angle:g}, must be below pi; it is in radians")
    return angle


def _size(entries: Entries, where: str) -> tuple[int, int] | None:
    """Return (width, height) in pixels, or None if the file has neither."""
    if "w" not in entries and "h" not in entries:
        return None
    return int(_positive(entries, "w", where)), int(_positive(entries, "h", where))


def _view(entry: object, where: str, folder: Path, camera: Camera | float, size: tuple[int, int] | None) -> View:
    if not isinstance(entry, dict) or "file_path" not in entry:
        raise MiNtfError(f"{where}: 'file_path' is missing; name the image relative to the folder")
    c2w = _numbers(entry, "transform_matrix", (4, 4), where, also=(3, 4))
    c2w = np.vstack([c2w, np.eye(4)[len(c2w):]])
    check_rigid(c2w, where, "'transform_matrix'")
    position = intensity = None
    if "pl_pos" in entry:
        position = _numbers(entry, "pl_pos", (3,), where, also=(4,))
        if len(position) == 4 and position[3] != 1:
            raise MiNtfError(f"{where}: 'pl_pos' has a fourth number, {position[3]:g}, which is 1 in homogeneous "
                             "coordinates; write x, y and z alone, and an intensity as 'pl_intensity'")
        position = position[:3]
    if "pl_intensity" in entry:
        shape = () if isinstance(entry["pl_intensity"], int | float) else (3,)
        intensity = np.broadcast_to(_numbers(entry, "pl_intensity", shape, where), (3,)).copy()
        if intensity.min() < 0 or intensity.max() <= 0:
            raise MiNtfError(f"{where}: 'pl_intensity' is {intensity.tolist()}, must be positive; leave it out in all "
                             "frames to have it estimated")
    name = _file_name(entry, "file_path", where)
    if Path(name).suffix.lower() not in file_names.SUFFIXES:
        extension = _file_name(entry, "file_ext", where) if entry.get("file_ext") else None
        name = _with_suffix(folder, name, extension, where)
    image, name = locate(folder, name), plain(name)
    masks = file_names.mask_places(folder / "masks", name)
    return View(where, image, name, masks, c2w, camera, size, position, intensity)


def _nerfstudio_view(data: Entries, entry: object, where: str, folder: Path) -> View:
    """Return the photograph of one frame, whose entries replace those of the file."""
    if not isinstance(entry, dict):
        raise MiNtfError(f"{where}: is {shown(entry)}, expected 'file_path', 'transform_matrix' and what the frame has "
                         "of its own")
    entries = data | entry
    view = _view(entry, where, folder, _nerfstudio_camera(entries, where), _size(entries, where))
    if "mask_path" in entry:
        mask = locate(folder, _file_name(entry, "mask_path", where))
        view = dataclasses.replace(view, masks=[mask], mask_first=True)
    return view


def _named_splits(data: Entries, views: list[View], path: Path) -> tuple[dict[str, list[View]], list[str]]:
    """Return the splits of the file's lists, and notes. Without a list, `train` is the rest."""
    lists = {f"{split}_filenames": data[f"{split}_filenames"] for split in SPLITS if data.get(f"{split}_filenames")}
    if not lists:
        return {"train": views}, []
    place = {os.path.normpath(view.name): view for view in views}
    splits = {}
    for key, names in lists.items():
        if not isinstance(names, list) or not all(map(is_file_name, names)):
            raise MiNtfError(f"{path}: '{key}' is {shown(names)}, expected a list of frames' 'file_path'")
        unknown = next((name for name in names if os.path.normpath(plain(name)) not in place), None)
        if unknown is not None:
            raise MiNtfError(f"{path}: '{key}' has {shown(unknown)}, which is the 'file_path' of no frame; write the "
                             "names alike")
        splits[key.removesuffix("_filenames")] = [place[os.path.normpath(plain(name))] for name in names]
    used = {id(view) for split in splits.values() for view in split}
    rest = [view for view in views if id(view) not in used]
    if "train" in splits:
        note = f"{len(rest)} of {len(views)} frames are not in {', '.join(lists)} and are left out"
        return splits, [note] if rest else []
    if not rest:
        raise MiNtfError(f"{path}: {', '.join(lists)} name all {len(views)} frames, which leaves none to train on; "
                         "name fewer, or write 'train_filenames'")
    return {"train": rest, **splits}, []


def _sphere(data: Entries, path: Path) -> Sphere | None:
    if "unit_sphere" not in data:
        return None
    entry, where = data["unit_sphere"], f"{path}, unit_sphere"
    return Sphere(_numbers(entry, "center", (3,), where), _positive(entry, "radius", where))


def _file_name(entry: Entries, key: str, where: str) -> str:
    name = entry[key]
    if not is_file_name(name):
        raise MiNtfError(f"{where}: '{key}' is {shown(name)}, expected the name of a file")
    return name


def _with_suffix(folder: Path, name: str, extension: str | None, where: str) -> str:
    """Return `name` with the suffix of the file that exists. A suffix that is not read raises its error later."""
    suffixes = [f".{extension.removeprefix('.')}"] if extension else [*file_names.SUFFIXES, ""]
    for suffix in suffixes:
        for base in (name, plain(name)):
            path = file_names.on_disk(folder / f"{base}{suffix}")
            if path is not None:
                return f"{base}{path.suffix if suffix else ''}"
    raise MiNtfError(f"{where}: {folder / name} does not exist with any of the extensions "
                     f"{' '.join(filter(None, suffixes))}; put the photograph there or take the frame out")


def _numbers(entry: object, key: str, shape: tuple[int, ...], where: str, also: tuple[int, ...] | None = None
             ) -> np.ndarray:
    """Return the finite float64 array `entry[key]` of `shape`, or of the shape `also`. Raises MiNtfError."""
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


def _number(entries: Entries, key: str, where: str) -> float:
    """Return the number `entries[key]`, 0 if it is missing."""
    return float(_numbers(entries, key, (), where)) if key in entries else 0.0


def _positive(entries: object, key: str, where: str) -> float:
    value = float(_numbers(entries, key, (), where))
    if not 1e-12 < value < 1e12:
        raise MiNtfError(f"{where}: '{key}' is {value:g}, must be positive, from 1e-12 to 1e12")
    return value
