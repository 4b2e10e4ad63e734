"""Reader of nerfstudio's `transforms.json`, and of instant-ngp's, from which it comes.

    fl_x, fl_y, cx, cy, w, h     pixels, for all frames or in each; (0, 0) is the corner of the top left pixel. Missing
                                 fl_y: fl_x; missing cx, cy: the middle; missing fl_x: `camera_angle_x` (radians)
    k1, k2, k3, p1, p2           lens distortion as OpenCV has it; k4 is another term than OpenCV's and must be 0
    camera_model                 OPENCV (also if missing), PINHOLE, SIMPLE_PINHOLE, RADIAL, SIMPLE_RADIAL
    frames                       file_path, transform_matrix (camera-to-world, OpenGL axes), mask_path (white: object)
    train_filenames, val_filenames, test_filenames    file_path of the frames of each split
    pl_pos, pl_intensity, unit_sphere                 as `schema` has them

Frames whose photograph is not there are left out, as instant-ngp does: blurred ones are deleted and stay in the file,
its own example (`fox`) among them.

Source: nerfstudio's documentation, "Data conventions"; for k4 its undistortion (`full_images_datamanager`), which
refuses it as well.
"""

import dataclasses
import os
from pathlib import Path

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import json_entries as entries
from mi_ntf.data.file_names import is_file_name, locate, plain
from mi_ntf.data.schema import SPLITS, Camera, Found, View, focal_length

FORM = "nerfstudio data set (transforms.json)"
STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE")
MODELS = ("OPENCV", "RADIAL", "SIMPLE_RADIAL", *STRAIGHT)
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
"""In OpenCV's order."""


def read(folder: Path) -> Found:
    """The splits that the file names, or all its frames as `train`. Raises MiNtfError."""
    path = folder / "transforms.json"
    data, assumed = entries.load(path)
    views = [_view(data, entry, f"{path}, frame {i}", folder) for i, entry in enumerate(data["frames"])]
    splits, notes = _splits(data, views, path)
    kept = {split: [view for view in chosen if view.image.is_file()] for split, chosen in splits.items()}
    count, left = (sum(map(len, each.values())) for each in (splits, kept))
    if left > count / 2 and kept["train"]:  # else it is another folder that is meant, or a copy that was broken off
        splits = {split: chosen for split, chosen in kept.items() if chosen}
        notes += [f"{count - left} of {count} frames have no photograph and are left out"] if left < count else []
    return Found(FORM, splits, entries.unit_sphere(data, path), None, notes, assumed)


def _view(data: dict, entry: object, where: str, folder: Path) -> View:
    """The photograph of one frame: what it says of its camera goes before what the file says of all."""
    if not isinstance(entry, dict):
        raise MiNtfError(f"{where}: is {shown(entry)}, expected 'file_path', 'transform_matrix' and what the frame has "
                         "of its own")
    both = data | entry
    view = entries.view(entry, where, folder, _camera(both, where), entries.size(both, where))
    if "mask_path" in entry:
        mask = locate(folder, entries.file_name(entry, "mask_path", where))
        view = dataclasses.replace(view, masks=[mask], mask_first=True)
    return view


def _camera(both: dict, where: str) -> Camera | float:
    """The camera by what frame and file say."""
    fisheye = " (is_fisheye)" if both.get("is_fisheye") else ""
    model = both.get("camera_model", "OPENCV")
    if model not in MODELS or fisheye:
        raise MiNtfError(f"{where}: its 'camera_model' is {shown(model)}{fisheye}; read are {', '.join(MODELS)}: "
                         "undistort the photographs first, for example with `colmap image_undistorter`, and train on "
                         "its output")
    bent = () if model in STRAIGHT else tuple(_number(both, key, where) for key in DISTORTION)
    if bent and _number(both, "k4", where):
        raise MiNtfError(f"{where}: 'k4' is {both['k4']}; that term is not undone: calibrate with k1 to k3, p1 and p2 "
                         "alone, or undistort the photographs first")
    bent = bent if any(bent) else ()
    if "fl_x" in both:
        fx = entries.positive(both, "fl_x", where)
    elif bent or "cx" in both or "cy" in both:
        fx = focal_length(entries.angle_x(both, where), entries.positive(both, "w", where))
    else:
        return entries.angle_x(both, where)
    fy = entries.positive(both, "fl_y", where) if "fl_y" in both else fx
    cx, cy = (_number(both, key, where) if key in both else 0.5 * entries.positive(both, side, where)
              for key, side in (("cx", "w"), ("cy", "h")))
    return Camera(fx, fy, cx, cy, bent)


def _number(both: dict, key: str, where: str) -> float:
    return float(entries.numbers(both, key, (), where)) if key in both else 0.0


def _splits(data: dict, views: list[View], path: Path) -> tuple[dict[str, list[View]], list[str]]:
    """``(splits, notes)``: by the file's lists, of which `train` may be missing and is then what the others leave."""
    named = {split: data[f"{split}_filenames"] for split in SPLITS if data.get(f"{split}_filenames")}
    if not named:
        return {"train": views}, []
    place = {os.path.normpath(view.name): view for view in views}
    splits = {}
    for split, names in named.items():
        if not isinstance(names, list) or not all(map(is_file_name, names)):
            raise MiNtfError(f"{path}: '{split}_filenames' is {shown(names)}, expected a list of frames' 'file_path'")
        unknown = next((name for name in names if os.path.normpath(plain(name)) not in place), None)
        if unknown is not None:
            raise MiNtfError(f"{path}: '{split}_filenames' has {shown(unknown)}, which is the 'file_path' of no frame; "
                             "write the names alike")
        splits[split] = [place[os.path.normpath(plain(name))] for name in names]
    lists = ", ".join(f"{split}_filenames" for split in named)
    used = {id(view) for split in splits.values() for view in split}
    rest = [view for view in views if id(view) not in used]
    if "train" in splits:
        note = f"{len(rest)} of {len(views)} frames are not in {lists} and are left out"
        return splits, [note] if rest else []
    if not rest:
        raise MiNtfError(f"{path}: {lists} name all {len(views)} frames, which leaves none to train on; name fewer, "
                         "or write 'train_filenames'")
    return {"train": rest, **splits}, []
