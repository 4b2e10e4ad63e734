"""`transforms*.json` as editors, other systems and other programs write them: read right, or refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from data import forms
from data.test_readers import check_cameras
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images
from mi_ntf.data.readers import load_dataset


def load(folder: Path):
    messages = []
    return load_dataset(folder, messages.append), "\n".join(messages)


def edit(folder: Path, change, *splits: str) -> None:
    """Put every frame of `splits` through `change`."""
    for split in splits or ("train", "val", "test"):
        path = folder / f"transforms_{split}.json"
        data = json.loads(path.read_text())
        for frame in data["frames"]:
            change(frame)
        path.write_text(json.dumps(data))


def encode(folder: Path, encoding: str) -> None:
    for path in folder.glob("transforms*.json"):
        path.write_bytes(path.read_text().encode(encoding))


def rename(folder: Path, suffix: str) -> None:
    for path in [*folder.rglob("*.png"), *folder.rglob("*.exr")]:
        path.rename(path.with_suffix(suffix))


def backslashes(frame: dict) -> None:
    frame["file_path"] = frame["file_path"].replace("/", "\\")


def latin(folder: Path) -> None:
    edit(folder, lambda f: f.update(note="Größe"))
    for path in folder.glob("transforms*.json"):
        path.write_bytes(json.dumps(json.loads(path.read_text()), ensure_ascii=False).encode("latin-1"))


@pytest.mark.parametrize(("form", "change"), [
    *((forms.blender, lambda f, e=e: encode(f, e)) for e in ("utf-8-sig", "utf-16", "utf-16-be", "utf-32")),
    (forms.blender, latin),
    (forms.blender, lambda f: edit(f, lambda frame: frame["transform_matrix"].pop())),
    (forms.blender, lambda f: edit(f, backslashes)),
    (forms.capture, lambda f: edit(f, backslashes)),
    (forms.blender, lambda f: rename(f, ".PNG")),
    (forms.blender, lambda f: rename(f, ".Png")),
    (forms.capture, lambda f: rename(f, ".EXR")),
    (forms.capture, lambda f: edit(f, lambda frame: frame.update(file_path=frame["file_path"][:-4] + ".EXR"))),
    (forms.nrhints, lambda f: edit(f, lambda frame: frame.update(file_ext="exr"))),
    (forms.nrhints, lambda f: edit(f, lambda frame: frame.update(file_ext=".EXR"))),
    (forms.nrhints, lambda f: edit(f, lambda frame: frame["pl_pos"].append(1))),
], ids=["byte-order mark", "UTF-16", "UTF-16 without a mark", "UTF-32", "Latin-1", "3x4", "Windows separators",
        "the same with extensions", ".PNG", ".Png", ".EXR", "named .EXR", "file_ext without a dot",
        "file_ext in capitals", "pl_pos of four numbers"])
def test_read_as_it_was_meant(tmp_path, form, change):
    change(form(tmp_path))
    splits, _ = load(tmp_path)
    for name, views in forms.splits().items():
        check_cameras(splits[name], views)
        # the file's 8 bits, and those over black: `test_readers.check_8_bit_pixels`
        np.testing.assert_allclose(images.linear(splits[name].images), forms.PICTURES[views],
                                   atol=(2 * 2.3 + 1) * 0.5 / 255)


def test_nerfstudio_of_windows(tmp_path):
    """Names of photographs, of masks and of lists."""
    forms.nerfstudio(tmp_path)
    (tmp_path / "m").mkdir()
    mask = np.zeros((24, 24), np.uint8)
    mask[4:20, 3:21] = 255
    Image.fromarray(mask).save(tmp_path / "m/m.PNG")
    path = tmp_path / "transforms.json"
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        backslashes(frame)
        frame["mask_path"] = "m\\m.png"
    for split in ("train", "val", "test"):
        data[f"{split}_filenames"] = [name.replace("/", "\\") for name in data[f"{split}_filenames"]]
    path.write_bytes(json.dumps(data).encode("utf-8-sig"))
    splits, _ = load(tmp_path)
    for name, views in forms.splits().items():
        check_cameras(splits[name], views)
        assert (splits[name].images[..., 3] == mask).all()


@pytest.mark.parametrize(("change", "text"), [
    (lambda frame: frame["pl_pos"].append(25), r"frame 0: 'pl_pos' has a fourth number, 25, which is 1 in homogeneous "
                                               r"coordinates; write x, y and z alone, and an intensity as 'pl_int"),
    (lambda frame: frame["pl_pos"].append(0), r"frame 0: 'pl_pos' has a fourth number, 0, which is 1"),
    (lambda frame: frame["pl_pos"].extend([1, 1]), r"frame 0: 'pl_pos' has shape \(5,\), expected \(3,\)"),
])
def test_refused(tmp_path, change, text):
    edit(forms.nrhints(tmp_path), change)
    with pytest.raises(MiNtfError, match=text):
        load(tmp_path)


def test_half_a_character_is_no_json(tmp_path):
    path = forms.blender(tmp_path) / "transforms_val.json"
    path.write_bytes(path.read_text().encode("utf-16")[:-1])
    with pytest.raises(MiNtfError, match=r"transforms_val.json: not valid JSON \(.*truncated data"):
        load(tmp_path)


@pytest.mark.parametrize(("form", "key"), [(forms.nrhints, "pl_pos"), (forms.capture, "pl_intensity"),
                                           (forms.capture, "pl_pos")])
def test_lights_of_the_training_split_alone(tmp_path, form, key):
    """The other splits' lights are not known: they are left out, and photographs are held back instead."""
    edit(form(tmp_path), lambda frame: frame.pop(key), "val", "test")
    splits, messages = load(tmp_path)
    assert [len(split.images) for split in splits.values()] == [12, 1, 1]
    remaining = [i for i in range(14) if i not in (6, 7)]
    np.testing.assert_allclose(splits["train"].c2w, forms.C2W[remaining], atol=1e-6)
    for split in ("val", "test"):
        assert (f"assumed: the {split} split is left out: none of its 1 frames has '{key}', which the frames for "
                "training have; write it there to use them") in messages
        assert f"no {split} split: 1 of" in messages


@pytest.mark.parametrize("form", [forms.blender, forms.capture])
def test_latin_1_is_said(tmp_path, form):
    latin(form(tmp_path))
    assert load(tmp_path)[1].count("is no UTF-8 and is read as Latin-1") == 3


def edit_file(folder: Path, change) -> None:
    """Put the contents of every file of the folder through `change`."""
    for path in folder.glob("transforms*.json"):
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))


INTRINSICS = {"fl_x": forms.FOCAL, "fl_y": forms.FOCAL, "cx": 12, "cy": 12, "w": 24, "h": 24}


@pytest.mark.parametrize(("form", "change"), [
    (forms.blender, lambda d: d.pop("camera_angle_x") and d.update(INTRINSICS)),
    (forms.blender, lambda d: d.update(INTRINSICS, camera_angle_x=0.5)),
    (forms.blender, lambda d: d.pop("camera_angle_x") and [f.update(INTRINSICS) for f in d["frames"]]),
    (forms.blender, lambda d: d.pop("camera_angle_x") and [f.update(camera_angle_x=forms.ANGLE) for f in d["frames"]]),
    (forms.blender, lambda d: d.update(fl_x=None, w=None, h=None)),
    (forms.nerfstudio, lambda d: [d.pop(key) for key in ("w", "h", "cx", "cy")]),
    (forms.nerfstudio, lambda d: [f.update(mask_path=None, k1=None, w=None) for f in d["frames"]]),
], ids=["fl_x", "fl_x goes before camera_angle_x", "fl_x of each frame", "camera_angle_x of each frame", "null",
        "sizes from the photographs", "null in frames"])
def test_cameras_as_other_programs_write_them(tmp_path, form, change):
    edit_file(form(tmp_path), change)
    for name, views in forms.splits().items():
        check_cameras(load(tmp_path)[0][name], views)


def test_lens_distortion_of_splits_is_undone(tmp_path):
    """A lens that magnifies the corners: the picture without it is wider."""
    edit_file(forms.blender(tmp_path), lambda d: d.update(INTRINSICS, k1=0.5))
    splits, messages = load(tmp_path)
    assert "lens distortion undone" in messages and (splits["train"].focal != forms.FOCAL).all()


@pytest.mark.parametrize("place", ["/home/somebody/set/", "C:\\Users\\somebody\\set\\", "D:/set/"])
def test_absolute_names_of_another_machine(tmp_path, place):
    """The photographs are there under the last parts of their names, and masks belong to those parts."""
    forms.nerfstudio(tmp_path)
    (tmp_path / "masks").mkdir()
    for path in sorted((tmp_path / "images").iterdir()):
        with Image.open(path) as image:
            image.getchannel("A").save(tmp_path / "masks" / path.name)
        image.convert("RGB").save(path)
    edit_file(tmp_path, lambda d: [f.update(file_path=place + f["file_path"][2:]) for f in d["frames"]])
    splits, messages = load(tmp_path)
    for name, views in forms.splits().items():
        check_cameras(splits[name], views)
    assert splits["test"].names == ("images/frame_00015.png",)
    assert f"assumed: 16 photographs are not at the places that {tmp_path}/transforms.json names (first {place}" in (
        messages.replace("\\\\", "\\"))


def test_data_sets_far_from_the_origin(tmp_path):
    """Georeferenced coordinates; a flash at the lens stays there."""
    forms.nerfstudio(tmp_path)
    plain = load(tmp_path)[0]["train"]

    def move(data):
        for frame in data["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] += [4.5e5, 5.4e6, 100.0]
            frame["transform_matrix"] = matrix.tolist()

    edit_file(tmp_path, move)
    far = load(tmp_path)[0]["train"]
    np.testing.assert_allclose(far.center - plain.center, [4.5e5, 5.4e6, 100.0], atol=1e-2)
    np.testing.assert_allclose(far.light_pos, far.c2w[:, :3, 3], rtol=0, atol=1e-6)


def test_cameras_at_one_place_with_rounding(tmp_path):
    """World-to-camera matrices with six digits, without the sphere of the object."""
    forms.nerfstudio(tmp_path)

    def invert(data):
        for frame in data["frames"]:
            frame["transform_matrix"] = np.linalg.inv(frame["transform_matrix"]).round(6).tolist()

    edit_file(tmp_path, invert)
    with pytest.raises(MiNtfError, match=r"cameras stand at .*invert them"):
        load(tmp_path)
