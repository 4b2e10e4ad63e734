"""Every accepted form gives back the same cameras and pixels; every fault has its sentence."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from data import forms
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images, schema
from mi_ntf.data.readers import load_dataset


def load(folder, **options):
    messages = []
    return load_dataset(folder, messages.append, **options), "\n".join(messages)


def check_cameras(split, views, rtol=1e-6):
    """Within 1e-6: the poses went through decimal text and, for COLMAP, through a quaternion, in float64."""
    np.testing.assert_allclose(split.c2w, forms.C2W[views], atol=rtol)
    np.testing.assert_allclose(split.focal, forms.FOCAL, rtol=rtol)
    np.testing.assert_allclose(split.principal, forms.SIZE / 2, rtol=rtol)
    np.testing.assert_allclose(split.light_pos, forms.C2W[views][:, :3, 3], rtol=rtol, atol=1e-6)


def check_8_bit_pixels(stored, views):
    """Check pixels within the rounding to 8 bits.

    Alpha has half a level. Colour has half a level times sRGB's slope, at most 2.3, in the file and once more over
    black, and half a level of premultiplication.
    """
    assert stored.dtype == np.uint8
    pixels, expected = images.linear(stored), forms.PICTURES[views]
    np.testing.assert_allclose(pixels[..., 3], expected[..., 3], atol=0.501 / 255)
    np.testing.assert_allclose(pixels[..., :3], expected[..., :3], atol=(2 * 2.3 + 1) * 0.5 / 255)


def check_sphere(split):
    """Check that the sphere holds both spheres and is at most a fifth larger than the smallest."""
    for center, radius in forms.SPHERES:
        assert np.linalg.norm(center - split.center) + radius <= split.radius
    center, radius = forms.true_bounds()
    assert split.radius < 1.2 * radius and np.linalg.norm(split.center - center) < 0.1 * radius


def check_estimate(split):
    """Check the estimated intensity: photographs determine intensity times albedo alone.

    The brightest albedo is 0.7, assumed to be 0.8, and the surface's distance to the flash is known to a quarter.
    """
    np.testing.assert_allclose(split.light_intensity, forms.INTENSITY * 0.7 / 0.8, rtol=0.5)


def test_capture(tmp_path):
    splits, messages = load(forms.capture(tmp_path))
    for name, views in forms.splits().items():
        check_cameras(splits[name], views)
        assert splits[name].images.dtype == np.float16
        np.testing.assert_array_equal(splits[name].images, forms.PICTURES[views].astype(np.float16))
        assert (splits[name].light_intensity == forms.INTENSITY).all()
        assert splits[name].radius == 1 and (splits[name].center == 0).all()
        assert splits[name].calibrated and splits[name].masked
        assert splits[name].names == tuple(f"{name}/{i:04d}.exr" for i in views)
    assert messages == f"photographs of `mi-ntf capture` in {tmp_path}: 16 photographs, 24x24 pixels"


def test_nerf_synthetic(tmp_path):
    splits, messages = load(forms.blender(tmp_path))
    for name, views in forms.splits().items():
        check_cameras(splits[name], views)
        check_8_bit_pixels(splits[name].images, views)
        check_sphere(splits[name])
        check_estimate(splits[name])
        assert not splits[name].calibrated
    assert messages.startswith(f"NeRF-synthetic (Blender) data set in {tmp_path}: 16 photographs, 24x24 pixels\n")
    assert "sphere is found from the masks' visual hull" in messages
    assert "a flash at the lens is assumed" in messages and "W/sr estimated" in messages


def test_photographs_under_a_known_light(tmp_path):
    """Nothing is said or estimated of a flash."""
    splits, messages = load(forms.blender(tmp_path), flash=False)
    assert "flash" not in messages and "W/sr" not in messages
    assert not splits["train"].calibrated and (splits["train"].light_intensity == 1).all()


def test_nrhints(tmp_path):
    splits, messages = load(forms.nrhints(tmp_path))
    for name, views in forms.splits().items():
        check_cameras(splits[name], views)
        assert splits[name].images.dtype == np.float16
        np.testing.assert_array_equal(splits[name].images, forms.PICTURES[views].astype(np.float16))
        check_estimate(splits[name])
    assert messages.startswith(f"NRHints data set in {tmp_path}: 16 photographs, 24x24 pixels\n")
    assert "flash at the lens" not in messages and "W/sr estimated" in messages


def test_light_positions_and_one_number_of_intensity_are_kept(tmp_path):
    forms.nrhints(tmp_path)
    for name in schema.SPLITS:
        edit(tmp_path, lambda d: [f.update(pl_intensity=4, pl_pos=[1, 2, 9]) for f in d["frames"]], name)
    splits, _ = load(tmp_path)
    assert (splits["val"].light_intensity == 4).all() and splits["val"].light_pos.tolist() == [[1, 2, 9]]


@pytest.mark.parametrize(("model", "binary", "place"), [
    ("PINHOLE", False, "sparse/0"), ("SIMPLE_PINHOLE", False, "sparse"),
    ("PINHOLE", True, "."), ("SIMPLE_PINHOLE", True, "sparse/0"),
])
def test_colmap(tmp_path, model, binary, place):
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP itself writes the binary files") if binary else None
    forms.colmap(tmp_path, model)
    stored = tmp_path / "sparse/0"
    if binary:
        pycolmap.Reconstruction(str(stored)).write_binary(str(stored))
        for file in stored.glob("*.txt"):
            file.unlink()
    for file in list(stored.iterdir()):
        file.rename(tmp_path / place / file.name)
    splits, messages = load(tmp_path)
    assert [len(splits[name].images) for name in schema.SPLITS] == [14, 1, 1]
    assert messages.startswith(f"COLMAP model in {tmp_path}: 16 photographs, 24x24 pixels\n")
    assert "no test split: 1 of 16" in messages and "no val split: 1 of 15" in messages
    # the middle one of 16, then of the 15 that are left
    views = {"train": [*range(7), *range(9, 16)], "val": [7], "test": [8]}
    for name, chosen in views.items():
        check_cameras(splits[name], chosen)
        check_8_bit_pixels(splits[name].images, chosen)
        check_sphere(splits[name])


def test_colmap_model_folder_itself(tmp_path):
    splits, _ = load(forms.colmap(tmp_path) / "sparse" / "0")
    assert len(splits["train"].images) == 14


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [1, 2**32, 2**63, 2**64 - 1])
def test_counts_of_binary_models_that_lie(tmp_path, name, count):
    """They end where the file ends: nothing is allocated or read for what is not there."""
    model = forms.colmap(tmp_path) / "sparse" / "0"
    empty = struct.pack("<Q", 0)
    for other in ("cameras", "images", "points3D"):
        (model / f"{other}.bin").write_bytes(empty)
    (model / f"{name}.bin").write_bytes(struct.pack("<Q", count) + b"\x01" * 20)
    with pytest.raises(MiNtfError, match=rf"{name}.bin: cannot be read as part of a COLMAP model"):
        load(tmp_path)


def _cut(folder: Path) -> None:
    (folder / "sparse/0/points3D.txt").write_text("1 0.5\n")


def _no_pose(folder: Path) -> None:
    path = folder / "sparse/0/images.txt"
    first, rest = path.read_text().split("\n", 1)
    path.write_text(" ".join([first.split()[0], *7 * ["nan"], *first.split()[8:]]) + "\n" + rest)


def _shrink(folder: Path) -> None:
    for kind in ("images", "masks"):
        Image.new("RGB", (12, 12)).save(folder / kind / "003.png")


@pytest.mark.parametrize(("model", "change", "text"), [
    ("OPENCV_FISHEYE", lambda f: None, r"camera 1: its model OPENCV_FISHEYE is not read .*`colmap image_undistorter` "
     r"and .* \(read as COLMAP model\)$"),
    ("PINHOLE", _no_pose, r"images.txt: cannot be read .*the pose of image '015.png' is \[nan, nan, nan, "),
    ("PINHOLE", _cut, r"points3D.txt: cannot be read .*has 2 words.*`colmap model_converter`"),
    ("PINHOLE", lambda f: (f / "images").rename(f / "photos"), "images does not exist; put the photographs of"),
    ("PINHOLE", lambda f: [p.unlink() for p in sorted((f / "images").iterdir())[2:12]],
     "images/002.png does not exist; the data set is incomplete"),
    ("PINHOLE", lambda f: (f / "masks/002.png").unlink(), "002.png: has no alpha channel and no mask"),
    ("PINHOLE", _shrink, "003.png: is 12x12, .*image '003.png' says 24x24; photograph and camera must belong together"),
])
def test_faults_of_colmap_folders(tmp_path, model, change, text):
    change(forms.colmap(tmp_path, model))
    with pytest.raises(MiNtfError, match=text):
        load(tmp_path)


def test_photographs_without_a_pose_are_counted(tmp_path):
    forms.colmap(tmp_path)
    (tmp_path / "images/late.jpg").write_bytes(b"")
    (tmp_path / "images/._000.png").write_bytes(b"")  # macOS leaves such files in archives
    assert "1 of 17 photographs in" in load(tmp_path)[1]


def test_poses_without_a_photograph_are_counted(tmp_path):
    """Somebody has deleted the blurred photograph."""
    (forms.colmap(tmp_path) / "images/003.png").unlink()
    splits, messages = load(tmp_path)
    assert "1 of 16 frames have no photograph and are left out\n" in messages and "have no pose" not in messages
    np.testing.assert_allclose(np.concatenate([split.c2w for split in splits.values()]).sum(0),
                               np.delete(forms.C2W, 3, 0).sum(0), atol=1e-6)


def test_hidden_files_of_macos_are_no_photographs(tmp_path):
    for path in list((forms.llff(tmp_path) / "images").iterdir()):
        path.with_name(f"._{path.name}").write_bytes(b"")
    assert "16 photographs" in load(tmp_path)[1]


# --- faults of transforms_*.json ------------------------------------------------------------------------------------


def edit(folder, change, split="train"):
    path = folder / f"transforms_{split}.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def frame(key, value):
    return lambda data: data["frames"][1].__setitem__(key, value)


def pose(function):
    """Edit that puts every frame's matrix through `function`."""
    def change(data):
        for entry in data["frames"]:
            entry["transform_matrix"] = np.asarray(function(np.array(entry["transform_matrix"]))).tolist()
    return change


def inside(data):
    data["frames"][1]["transform_matrix"][0][3] = 0.1
    data["frames"][1]["transform_matrix"][1][3] = 0.2
    data["frames"][1]["transform_matrix"][2][3] = 0.2


SCALED, MIRRORED, SHEARED = (np.diag(d) for d in ([2.0, 2, 2, 1], [1.0, 1, -1, 1], [1.0, 1.1, 1, 1]))


@pytest.mark.parametrize(("change", "text"), [
    (lambda d: d.update(frames=[]), "transforms_train.json: 'frames' is empty"),
    (lambda d: d["frames"][0].pop("file_path"), "frame 0: 'file_path' is missing; name the image"),
    (frame("transform_matrix", [[1, 0], [0, 1]]), r"frame 1: 'transform_matrix' has shape \(2, 2\), expected \(4, 4\)"),
    (frame("transform_matrix", SCALED.tolist()), "frame 1: 'transform_matrix' is no rigid motion, .*scaled by 2;"),
    (frame("transform_matrix", MIRRORED.tolist()), r"frame 1: 'transform_matrix' is mirrored \(determinant -1, handed"),
    (frame("transform_matrix", SHEARED.tolist()), r"frame 1: 'transform_matrix' is no rigid motion .*remove shear"),
    (frame("transform_matrix", np.eye(4)[[0, 1, 3, 2]].tolist()), "frame 1: .* its last row is .*keep it 0 0 0 1"),
    (pose(lambda m: m * [1, -1, -1, 1]), r"frame 0: this and all 14 cameras look away .*OpenCV's: negate the second"),
    (pose(np.linalg.inv), r"frame 0: all 14 cameras stand at .*world-to-camera matrices, invert them"),
    (inside, r"frame 1: the camera is inside the object, 0\.3 radii from .*\('unit_sphere' of the data set"),
    (frame("pl_pos", [0, float("nan"), 0]), r"frame 1: 'pl_pos' is not finite: \[0.0, nan, 0.0\]"),
    (frame("pl_intensity", "bright"), "'pl_intensity' is 'bright', expected numbers"),
    (frame("pl_intensity", [0, 0, 0]), r"'pl_intensity' is \[0.0, 0.0, 0.0\], must be positive"),
    (lambda d: d["frames"][0].pop("pl_pos"), "frame 0: 'pl_pos' is missing, 15 other frames have it"),
    (lambda d: d["frames"][2].pop("pl_intensity"), "frame 2: 'pl_intensity' is missing, 15 other frames have it"),
    (frame("file_path", "gone.exr"), "gone.exr does not exist; the data set is incomplete"),
    (frame("file_path", "gone"), "frame 1: .*gone does not exist with any of the extensions .png .exr .jpg .jpeg"),
    (lambda d: d.update(w=7), "0000.exr: is 24x24, .*transforms_train.json, frame 0 says 7x24"),
    (lambda d: d.update(camera_angle_x=40.0), "'camera_angle_x' is 40, must be below pi; it is in radians"),
    (lambda d: d.pop("camera_angle_x"), "'camera_angle_x' is missing"),
    (lambda d: d.update(camera_intrinsics=[12, 12, -5, 5]), r"the focal lengths, its last two numbers"),
    (lambda d: d.update(camera_intrinsics=[400, 300, 500, 500]), r"its principal point is \(400, 300\), outside the"),
    (frame("file_path", 7), "frame 1: 'file_path' is 7, expected the name of a file"),
    (frame("file_path", "a" * 5000), "frame 1: 'file_path' is 'aaa.*[.]{3}, expected the name of a file"),
    (frame("file_path", "\x00.png"), r"frame 1: 'file_path' is '.x00.png', expected the name of a file"),
    (lambda d: d.update(frames=7), "'frames' is empty or missing"),
    (lambda d: d["unit_sphere"].update(radius=10**400), "unit_sphere: 'radius' is 1000.*[.]{3}, expected numbers"),
    (lambda d: d["unit_sphere"].update(radius=1e-300), "unit_sphere: 'radius' is 1e-300, must be positive, from 1e-12"),
    (lambda d: d.update(camera_angle_x=1e-9), "focal lengths are 2.4e[+]10 and 2.4e[+]10 pixels, .*no pinhole camera"),
    (lambda d: d["unit_sphere"].update(radius=0), "unit_sphere: 'radius' is 0, must be positive"),
    (lambda d: d["unit_sphere"].pop("center"), "unit_sphere: 'center' is missing"),
    (lambda d: d["unit_sphere"].update(radius=2), r"'unit_sphere' is \[0.0, 0.0, 0.0\], 1, another split says .*, 2"),
])
def test_faults_of_transforms(tmp_path, change, text):
    edit(forms.capture(tmp_path), change)
    with pytest.raises(MiNtfError, match=text):
        load(tmp_path)


def test_faults_of_whole_splits(tmp_path):
    forms.capture(tmp_path)
    edit(tmp_path, lambda d: d.update(frames=[]), "val")
    with pytest.raises(MiNtfError, match=r"transforms_val.json: 'frames' is empty or missing; a split needs one"):
        load(tmp_path)
    (tmp_path / "transforms_val.json").write_text("{")
    with pytest.raises(MiNtfError, match=r"transforms_val.json: not valid JSON"):
        load(tmp_path)
    (tmp_path / "transforms_val.json").unlink()
    splits, messages = load(tmp_path)
    assert messages.split("\n")[1:] == ["no val split: 1 of 14 photographs for training are held back for it"]
    check_cameras(splits["val"], [7])
    edit(tmp_path, lambda d: d.update(frames=d["frames"][:1]))
    with pytest.raises(MiNtfError, match=r"frame 0: there is no val split and 1 photograph for training, too few"):
        load(tmp_path)


def test_faults_of_pictures(tmp_path):
    forms.capture(tmp_path)
    schema.write_exr(tmp_path / "train/0002.exr", np.zeros((24, 24, 4)))
    with pytest.raises(MiNtfError, match=r"0002.exr: its alpha is 0 at most, so it shows no object; repair its mask"):
        load(tmp_path)
    edit(tmp_path, lambda d: (d.pop("w"), d.pop("h")))
    schema.write_exr(tmp_path / "train/0002.exr", np.ones((24, 23, 4)))
    with pytest.raises(MiNtfError, match=r"0002.exr: is 23x24, .*0000.exr is 24x24; all photographs of a split"):
        load(tmp_path)
    schema.write_exr(tmp_path / "train/0002.exr", np.full((24, 24, 4), np.nan))
    with pytest.raises(MiNtfError, match=r"0002.exr: 576 pixels are NaN or infinite"):
        load(tmp_path)


def test_black_pictures_and_masks_that_do_not_meet(tmp_path):
    forms.blender(tmp_path)
    train = forms.splits()["train"]
    for i in train:
        rgba = forms.straight_srgb(forms.PICTURES[i])
        rgba[..., :3] = 0
        Image.fromarray(rgba).save(tmp_path / f"train/r_{i}.png")
    with pytest.raises(MiNtfError, match="none of the 14 photographs for training shows anything lit"):
        load(tmp_path)
    for i in train:
        corner = np.zeros((24, 24, 4), np.uint8)
        corner[slice(2) if i % 2 else slice(22, 24), slice(2) if i % 3 else slice(22, 24)] = 255
        Image.fromarray(corner).save(tmp_path / f"train/r_{i}.png")
    with pytest.raises(MiNtfError, match=r"no point in space is covered .* \(photograph \d+ of 0 to 13 for training"):
        load(tmp_path)


def test_folders_that_hold_nothing(tmp_path):
    with pytest.raises(MiNtfError, match=r"neither transforms_train.json .* nor a COLMAP model .* nor poses_bounds"):
        load(tmp_path)
    with pytest.raises(MiNtfError, match=r"gone does not exist or is no folder; make a data set with `mi-ntf capture"):
        load(tmp_path / "gone")


def test_the_folder_that_was_meant_is_named(tmp_path):
    folder = forms.nerfstudio(tmp_path / "sets" / "spheres")
    forms.blender(tmp_path / "sets" / "other")
    for given, named in ((folder / "images", folder), (folder.parent, f"{folder.parent / 'other'} and {folder}")):
        with pytest.raises(MiNtfError, match=rf"{given}: no data set is here, but {named} holds? one"):
            load(given)
    with pytest.raises(MiNtfError, match=rf"transforms.json is a file; name the folder that it is in, {folder}"):
        load(folder / "transforms.json")


@pytest.mark.parametrize("place", [".", "images"])
def test_photographs_without_poses_say_how_to_find_them(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    for number in range(3):
        (tmp_path / place / f"IMG_{number}.JPG").touch()
    with pytest.raises(MiNtfError, match=rf"{tmp_path}: 3 photographs are here, but no camera poses; .* `colmap auto"):
        load(tmp_path)
