"""Readers of `transforms_<split>.json` (our captures, NeRF-synthetic, NRHints) and of nerfstudio's `transforms.json`.

:func:`read_splits` reads a file for each split. The camera is `camera_angle_x` (radians), NRHints' `camera_intrinsics`
[cx, cy, fx, fy] (pixels), or as below. `file_path` may lack its extension, which NRHints names in `file_ext`. `pl_pos`
is x, y, z or x, y, z, 1; without it the light is at the camera. `pl_intensity` is one number or RGB. Missing `w`, `h`,
`pl_intensity` and `unit_sphere` are derived from the images.

:func:`read_nerfstudio` reads the file of nerfstudio and instant-ngp. An entry of a frame replaces that of the file:

    fl_x, fl_y, cx, cy, w, h     pixels, for all frames or in each; (0, 0) is the corner of the top left pixel. Missing
                                 fl_y: fl_x; missing cx, cy: the middle; missing fl_x: `camera_angle_x` (radians)
    k1, k2, k3, p1, p2           lens distortion as OpenCV has it; k4 is another term than OpenCV's and must be 0
    camera_model                 OPENCV (also if missing), PINHOLE, SIMPLE_PINHOLE, RADIAL, SIMPLE_RADIAL
    frames                       file_path, transform_matrix (camera-to-world, OpenGL axes), mask_path (white: object)
    train_filenames, val_filenames, test_filenames    file_path of the frames of each split

Frames of nerfstudio without a photograph are dropped, as instant-ngp does. An entry that is null counts as missing.
Every fault names file, frame and value.
Sources: the loaders of NeRF (Mildenhall et al. 2020) and NRHints (Zeng et al. 2023); nerfstudio's "Data conventions",
and for k4 its undistortion (`full_images_datamanager`), which refuses it as well.
"""

import json
import os
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import file_names, images
from mi_ntf.data.estimates import Sphere
from mi_ntf.data.file_names import is_file_name, locate, plain
from mi_ntf.data.poses import check_rigid
from mi_ntf.data.schema import SPLITS, Camera, DataSet, View, drop_missing, focal_length

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
    with_intrinsics = False
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if split == "train" or path.is_file():
            data, frames = _load(path, notes)
            views[split] = _views(data, frames, path, notes)
            with_intrinsics |= "camera_intrinsics" in data
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
    elif with_intrinsics or any(view.light_pos is not None for view in views["train"]):
        form = "NRHints data set"
    else:
        form = "NeRF-synthetic (Blender) data set"
    return DataSet(form, views, expected, assumed=notes)


def read_nerfstudio(folder: Path) -> DataSet:
    """Read the splits that `transforms.json` names, or all its frames as `train`. Raises MiNtfError."""
    path = folder / "transforms.json"
    assumed: list[str] = []
    data, frames = _load(path, assumed)
    splits, notes = _named_splits(data, _views(data, frames, path, assumed), path)
    splits, missing = drop_missing(splits)
    return DataSet(NERFSTUDIO, splits, _sphere(data, path), None, notes + missing, assumed)


def _load(path: Path, assumed: list[str]) -> tuple[Entries, list[object]]:
    """Return the contents of the file and its `frames`; assumptions about the text are added to `assumed`."""
    try:
        text, note = file_names.read_text(path)
        data = json.loads(text, object_hook=_without_nulls)
    except (OSError, ValueError, RecursionError) as error:  # also half a character of UTF-16
        raise MiNtfError(f"{path}: not valid JSON ({error}); the file is damaged, capture or copy it again") from None
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise MiNtfError(f"{path}: 'frames' is empty or missing; a split needs one photograph at least")
    assumed += [note] if note else []
    return data, data["frames"]


def _without_nulls(entries: Entries) -> Entries:
    return {key: value for key, value in entries.items() if value is not None}


def _views(data: Entries, frames: list[object], path: Path, assumed: list[str]) -> list[View]:
    """Return the photographs of all frames; an assumption about their places is added to `assumed`."""
    views = [_view(data, entry, f"{path}, frame {i}", path.parent) for i, entry in enumerate(frames)]
    names = [str(entry["file_path"]) for entry in frames if isinstance(entry, dict)]
    assumed += file_names.note_moved(names, [view.name for view in views], path)
    return views


def _intrinsics(data: Entries, where: str) -> Camera:
    """Return the camera of NRHints' entry."""
    cx, cy, fx, fy = map(float, _numbers(data, "camera_intrinsics", (4,), where))
    if min(fx, fy) <= 0:
        raise MiNtfError(f"{where}: 'camera_intrinsics' is {data['camera_intrinsics']}; the focal lengths, its "
                         "last two numbers [cx, cy, fx, fy], must be positive")
    return Camera(fx, fy, cx, cy)


def _camera(entries: Entries, image: Path, where: str) -> Camera | float:
    """Return the camera of the entries of a frame and of its file. Missing sizes are those of the file `image`."""
    if "camera_intrinsics" in entries:
        return _intrinsics(entries, where)
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
    if not (bent or {"fl_x", "cx", "cy"} & entries.keys()):
        return _angle_x(entries, where)
    if not {"w", "h"} <= entries.keys():
        entries = dict(zip("wh", images.size_of(image) or (), strict=False)) | entries
    if "fl_x" in entries:
        fx = _positive(entries, "fl_x", where)
    else:
        fx = focal_length(_angle_x(entries, where), _positive(entries, "w", where))
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


def _view(data: Entries, frame: object, where: str, folder: Path) -> View:
    """Return the photograph of one frame, whose entries replace those of the file, `data`."""
    if not isinstance(frame, dict):
        raise MiNtfError(f"{where}: is {shown(frame)}, expected 'file_path', 'transform_matrix' and what the frame has "
                         "of its own")
    if "file_path" not in frame:
        raise MiNtfError(f"{where}: 'file_path' is missing; name the image relative to the folder")
    c2w = _numbers(frame, "transform_matrix", (4, 4), where, also=(3, 4))
    c2w = np.vstack([c2w, np.eye(4)[len(c2w):]])
    check_rigid(c2w, where, "'transform_matrix'")
    name = _file_name(frame, "file_path", folder, where)
    if Path(name).suffix.lower() not in file_names.SUFFIXES:
        extension = _file_name(frame, "file_ext", folder, where) if frame.get("file_ext") else None
        name = _with_suffix(folder, name, extension, where)
    image, name = locate(folder, name), plain(name)
    camera, size = _camera(data | frame, image, where), _size(data | frame, where)
    with_mask = "mask_path" in frame
    masks = ([locate(folder, _file_name(frame, "mask_path", folder, where))] if with_mask
             else file_names.mask_places(folder / "masks", name))
    return View(where, image, name, masks, c2w, camera, size, *_light(frame, where), mask_first=with_mask)


def _light(frame: Entries, where: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the place (3,) and the radiant intensity (3,) of the light, None for what the frame does not give."""
    position = intensity = None
    if "pl_pos" in frame:
        position = _numbers(frame, "pl_pos", (3,), where, also=(4,))
        if len(position) == 4 and position[3] != 1:
            raise MiNtfError(f"{where}: 'pl_pos' has a fourth number, {position[3]:g}, which is 1 in homogeneous "
                             "coordinates; write x, y and z alone, and an intensity as 'pl_intensity'")
        position = position[:3]
    if "pl_intensity" in frame:
        shape = () if isinstance(frame["pl_intensity"], int | float) else (3,)
        intensity = np.broadcast_to(_numbers(frame, "pl_intensity", shape, where), (3,)).copy()
        if intensity.min() < 0 or intensity.max() <= 0:
            raise MiNtfError(f"{where}: 'pl_intensity' is {intensity.tolist()}, must be positive; leave it out in all "
                             "frames to have it estimated")
    return position, intensity


def _named_splits(data: Entries, views: list[View], path: Path) -> tuple[dict[str, list[View]], list[str]]:
    """Return the splits of the file's lists, and notes. Without a list, `train` is the rest."""
    lists = {f"{split}_filenames": data[f"{split}_filenames"] for split in SPLITS if data.get(f"{split}_filenames")}
    if not lists:
        return {"train": views}, []
    keyed = [(os.path.normpath(view.name), view) for view in views]
    place = {os.path.splitext(name)[0]: view for name, view in keyed} | dict(keyed)
    splits = {}
    for key, names in lists.items():
        if not isinstance(names, list) or not all(map(is_file_name, names)):
            raise MiNtfError(f"{path}: '{key}' is {shown(names)}, expected a list of frames' 'file_path'")
        listed = [place.get(os.path.normpath(plain(file_names.moved(path.parent, name)))) for name in names]
        if None in listed:
            raise MiNtfError(f"{path}: '{key}' has {shown(names[listed.index(None)])}, which is the 'file_path' of no "
                             "frame; write the names alike")
        splits[key.removesuffix("_filenames")] = [view for view in listed if view]
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


def _file_name(entry: Entries, key: str, folder: Path, where: str) -> str:
    """Return the name of a file; one in `folder` if `entry` has a place on another machine."""
    name = entry[key]
    if not is_file_name(name):
        raise MiNtfError(f"{where}: '{key}' is {shown(name)}, expected the name of a file")
    return file_names.moved(folder, name)


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
