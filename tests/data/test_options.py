"""Masks of a folder of any name, a flash beside the lens, and the forms of LLFF and nerfstudio."""

import json

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


def edit(folder, change, name="transforms.json"):
    data = json.loads((folder / name).read_text())
    change(data)
    (folder / name).write_text(json.dumps(data))


# --- masks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["{}.png", "{}.png.png", "{}.tif", "{}.jpeg"])
def test_masks_of_a_folder_of_any_name(tmp_path, name):
    """By the photograph's name with any suffix."""
    folder = forms.colmap(tmp_path / "set")
    expected = load(folder)[0]["train"].images
    (folder / "masks").rename(tmp_path / "white is object")
    with pytest.raises(MiNtfError, match=r"000.png: has no alpha channel and no mask"):
        load(folder)
    for path in sorted((tmp_path / "white is object").iterdir()):
        Image.open(path).save(tmp_path / "white is object" / name.format(path.stem), quality=100)
        if name != "{}.png":
            path.unlink()
    result = load(folder, masks=tmp_path / "white is object")[0]["train"].images
    # JPEG of full quality moves a level or two
    assert np.abs(result[..., 3].astype(int) - expected[..., 3]).max() <= (2 if name == "{}.jpeg" else 0)


def test_a_folder_of_masks_goes_before_alpha(tmp_path):
    """Names that are one split's alone may lie flat; `train/3` and `test/3` must keep their folder."""
    forms.blender(tmp_path)
    (tmp_path / "m").mkdir()
    for views in forms.splits().values():
        for i in views:
            mask = np.full((24, 24), 255, np.uint8)
            mask[:, : 12 - i % 3] = 0
            Image.fromarray(mask).save(tmp_path / "m" / f"r_{i}.png")
    train = load(tmp_path, masks=tmp_path / "m")[0]["train"].images
    assert (train[1, :, :11, 3] == 0).all() and (train[1, :, 11:, 3] == 255).all() and (train[0, :, 11, 3] == 0).all()
    for split in ("train", "test"):
        edit(tmp_path, lambda d, split=split: d["frames"][0].update(file_path=f"{split}/same"),
             f"transforms_{split}.json")
        Image.fromarray(np.zeros((24, 24, 4), np.uint8)).save(tmp_path / split / "same.png")
    Image.fromarray(np.zeros((24, 24), np.uint8)).save(tmp_path / "m" / "same.png")
    with pytest.raises(MiNtfError, match=r"train/same.png: has no mask \(.*m/train/same.png\); training must tell"):
        load(tmp_path, masks=tmp_path / "m")


def test_a_folder_of_masks_that_is_not_there(tmp_path):
    with pytest.raises(MiNtfError, match=r"gone does not exist or is no folder; name the folder that holds the masks"):
        load(forms.blender(tmp_path), masks=tmp_path / "gone")


# --- the flash -------------------------------------------------------------------------------------------------------


def test_a_flash_beside_the_lens(tmp_path):
    """Right, up and forward along the camera's own axes, of every view of every split."""
    splits, messages = load(forms.blender(tmp_path), flash_offset=(0.1, 1.2, -0.3))
    for name, views in forms.splits().items():
        for light, c2w in zip(splits[name].light_pos, forms.C2W[views], strict=True):
            right, up, back, place = c2w[:3].T
            np.testing.assert_allclose(light, place + 0.1 * right + 1.2 * up + 0.3 * back, atol=1e-6)
    assert "the flash is taken to be 0.1 right, 1.2 up, -0.3 forward of the lens" in messages
    assert "at the lens" not in messages
    with pytest.raises(MiNtfError, match=r"flash_offset is \(1, nan, 2\), expected three numbers: right, up, forward"):
        load(tmp_path, flash_offset=(1, float("nan"), 2))


def test_a_flash_that_training_will_find(tmp_path):
    """The note that the reflectance comes out wrong is for those who do not know of the option."""
    _, messages = load(forms.blender(tmp_path))
    assert "a flash at the lens is assumed" in messages and "`train --flash-offset estimate` finds it" in messages
    splits, messages = load(tmp_path, flash_offset="estimate")
    assert "training estimates where the flash stands" in messages and "assumed" not in messages
    assert not splits["train"].located
    assert "where the flash stands" not in load(forms.nrhints(tmp_path / "lit"), flash_offset="estimate")[1]


def test_a_flash_that_the_data_set_places_itself(tmp_path):
    with pytest.raises(MiNtfError, match=r"frame 0: 'pl_pos' says where the light is, and so does a flash offset of "
                                         r"\[0, 1, 0\]; leave one of the two out \(read as NRHints data set\)"):
        load(forms.nrhints(tmp_path), flash_offset=(0, 1, 0))


def test_a_light_anywhere(tmp_path):
    """NRHints' moving lights: wherever the data set says, for each photograph."""
    forms.nrhints(tmp_path)
    lights = np.random.default_rng(0).normal(size=(forms.VIEWS, 3)) * 5
    for name, views in forms.splits().items():
        edit(tmp_path, lambda d, v=views: [f.update(pl_pos=lights[i].tolist())
                                           for f, i in zip(d["frames"], v, strict=True)], f"transforms_{name}.json")
    splits, _ = load(tmp_path)
    np.testing.assert_allclose(splits["train"].light_pos, lights[forms.splits()["train"]], rtol=1e-6)


# --- LLFF and nerfstudio ---------------------------------------------------------------------------------------------


def check(split, views):
    """Within 1e-6: decimal text and float32 lights."""
    np.testing.assert_allclose(split.c2w, forms.C2W[views], atol=1e-12)
    np.testing.assert_allclose(split.focal, forms.FOCAL, rtol=1e-12)
    np.testing.assert_allclose(split.principal, forms.SIZE / 2)
    np.testing.assert_allclose(split.light_pos, forms.C2W[views][:, :3, 3], rtol=1e-6)
    # the file's 8 bits, and those over black: `test_readers.check_8_bit_pixels`
    np.testing.assert_allclose(images.linear(split.images), forms.PICTURES[views], atol=(2 * 2.3 + 1) * 0.5 / 255)
    for center, radius in forms.SPHERES:
        assert np.linalg.norm(center - split.center) + radius <= split.radius < 1.2 * forms.true_bounds()[1]


def test_nerfstudio(tmp_path):
    splits, messages = load(forms.nerfstudio(tmp_path))
    for name, views in forms.splits().items():
        check(splits[name], views)
    assert messages.startswith(f"nerfstudio data set (transforms.json) in {tmp_path}: 16 photographs, 24x24 pixels\n")
    assert splits["test"].names == ("images/frame_00015.png",)


@pytest.mark.parametrize("factor", [1, 4])
def test_llff(tmp_path, factor):
    """Photographs may be smaller than those of the poses."""
    splits, messages = load(forms.llff(tmp_path, factor))
    assert messages.startswith(f"LLFF data set (poses_bounds.npy) in {tmp_path}: 16 photographs, 24x24 pixels\n")
    for name, views in {"train": [*range(7), *range(9, 16)], "val": [7], "test": [8]}.items():
        check(splits[name], views)


def test_all_forms_have_the_same_rays(tmp_path):
    expected = None
    for form in (forms.capture, forms.blender, forms.nrhints, forms.nerfstudio):
        split = load(form(tmp_path / form.__name__))[0]["train"]
        result = schema.pixel_rays(split.c2w, split.focal, 24, 24, split.principal)
        expected = expected or result
        np.testing.assert_allclose(result, expected, atol=1e-12)


def test_nerfstudio_without_lists_and_with_less_of_the_camera(tmp_path):
    """The camera is a field of view alone, or with the principal point; frames may have their own intrinsics."""
    forms.nerfstudio(tmp_path)
    edit(tmp_path, lambda d: [d.pop(k) for k in ("train_filenames", "val_filenames", "test_filenames", "fl_x", "fl_y")])
    edit(tmp_path, lambda d: d.update(camera_angle_x=forms.ANGLE))
    splits, messages = load(tmp_path)
    assert "no test split: 1 of 16" in messages
    check(splits["train"], [*range(7), *range(9, 16)])
    edit(tmp_path, lambda d: [d.pop(k) for k in ("cx", "cy", "w", "h", "camera_model")])
    check(load(tmp_path)[0]["train"], [*range(7), *range(9, 16)])
    edit(tmp_path, lambda d: d["frames"][0].update(fl_x=50.0, w=24, h=24, cx=11.0))
    split = load(tmp_path)[0]["train"]
    assert split.focal[0].tolist() == [50, 50] and split.principal[0].tolist() == [11, 12]
    np.testing.assert_allclose(split.focal[1:], forms.FOCAL)


def test_nerfstudios_lists_of_names(tmp_path):
    """Frames in no list are left out; without `train_filenames` they are trained on."""
    forms.nerfstudio(tmp_path)
    edit(tmp_path, lambda d: d.update(train_filenames=d["train_filenames"][:10]))
    splits, messages = load(tmp_path)
    assert [len(s.images) for s in splits.values()] == [10, 1, 1]
    assert "4 of 16 frames are not in train_filenames, val_filenames, test_filenames and are left out" in messages
    edit(tmp_path, lambda d: d.pop("train_filenames"))
    assert [len(s.images) for s in load(tmp_path)[0].values()] == [14, 1, 1]


def test_frames_without_a_photograph_are_left_out_unless_most_are(tmp_path):
    """The data set is like instant-ngp's `fox`, in which 17 of 67 frames have no file."""
    forms.nerfstudio(tmp_path)
    (tmp_path / "images/frame_00003.png").unlink()
    splits, messages = load(tmp_path)
    assert "1 of 16 frames have no photograph and are left out\n" in messages
    np.testing.assert_allclose(splits["train"].c2w, np.delete(forms.C2W[:-2], 3, 0), atol=1e-6)
    for i in range(4, 13):
        (tmp_path / f"images/frame_{i:05d}.png").unlink()
    with pytest.raises(MiNtfError, match=r"frame_00003\.png does not exist; the data set is incomplete"):
        load(tmp_path)


def test_nerfstudios_masks_and_lights(tmp_path):
    """`mask_path` is meant: it goes before an alpha channel. Lights and the sphere are those of a capture."""
    forms.nerfstudio(tmp_path)
    mask = np.zeros((24, 24), np.uint8)
    mask[4:20, 3:21] = 255
    Image.fromarray(mask).save(tmp_path / "m.png")
    edit(tmp_path, lambda d: [f.update(mask_path="m.png", pl_pos=[1, 2, 9], pl_intensity=4) for f in d["frames"]])
    edit(tmp_path, lambda d: d.update(unit_sphere={"center": [0, 0, 0], "radius": 1}))
    split = load(tmp_path)[0]["train"]
    np.testing.assert_array_equal(split.images[3, ..., 3], mask)
    assert split.light_pos[0].tolist() == [1, 2, 9] and (split.light_intensity == 4).all() and split.radius == 1
    assert split.calibrated
    edit(tmp_path, lambda d: d["frames"][1].update(mask_path="gone.png"))
    with pytest.raises(MiNtfError, match=r"frame_00001.png: has no mask \(.*gone.png\); training must tell"):
        load(tmp_path)


@pytest.mark.parametrize(("change", "text"), [
    (lambda d: d.update(camera_model="OPENCV_FISHEYE"), r"frame 0: its 'camera_model' is 'OPENCV_FISHEYE'; read are "
     r"OPENCV, .*undistort the photographs first, .* \(read as nerfstudio data set \(transforms.json\)\)$"),
    (lambda d: d.update(is_fisheye=True), r"frame 0: its 'camera_model' is 'OPENCV' \(is_fisheye\)"),
    (lambda d: d.update(k4=0.1), r"frame 0: 'k4' is 0.1; that term is not undone: calibrate with k1 to k3"),
    (lambda d: d.update(k1="x"), r"frame 0: 'k1' is 'x', expected numbers"),
    (lambda d: d.pop("fl_x"), r"frame 0: 'camera_angle_x' is missing"),
    (lambda d: d["frames"].__setitem__(3, 7), r"frame 3: is 7, expected 'file_path', 'transform_matrix' and"),
    (lambda d: d.update(w=25), r"frame_00000.png: is 24x24, .*transforms.json, frame 0 says 25x24; photograph and"),
    (lambda d: d.update(test_filenames=["gone.png"]), r"'test_filenames' has 'gone.png', which is the 'file_path' of"),
    (lambda d: d.update(test_filenames=7), r"'test_filenames' is 7, expected a list of frames' 'file_path'"),
    (lambda d: (d.pop("train_filenames"), d.update(val_filenames=[f["file_path"] for f in d["frames"]])),
     r"val_filenames, test_filenames name all 16 frames, which leaves none to train on; name fewer, or write"),
    (lambda d: d.pop("frames"), r"transforms.json: 'frames' is empty or missing"),
    (lambda d: d["frames"][2].update(mask_path=3), r"frame 2: 'mask_path' is 3, expected the name of a file"),
])
def test_faults_of_nerfstudio(tmp_path, change, text):
    edit(forms.nerfstudio(tmp_path), change)
    with pytest.raises(MiNtfError, match=text):
        load(tmp_path)


@pytest.mark.parametrize(("change", "text"), [
    (lambda rows: rows[:-1], r"poses_bounds.npy: has 15 poses, .*images has 16 photographs; one belongs to each"),
    (lambda rows: rows[:, :15], r"poses_bounds.npy: is an array of float64 with shape \(16, 15\), expected numbers"),
    (lambda rows: rows * np.where(np.arange(17) == 9, -1, 1), r"its height, width and focal length"),
    (lambda rows: np.where(np.arange(17) == 3, np.nan, rows), r"row 0 \(IMG_000.png\): is not finite"),
    (lambda rows: rows * 2, r"row 0 \(IMG_000.png\): its pose is no rigid motion, its rotation is scaled by 2"),
    (lambda rows: rows * np.where(np.arange(17) == 9, 2, 1), r"IMG_000.png: is 24x24, .*row 0 .* says 48x24; photog"),
])
def test_faults_of_llff(tmp_path, change, text):
    path = forms.llff(tmp_path) / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(MiNtfError, match=text):
        load(tmp_path)


def test_faults_of_llffs_files(tmp_path):
    path = forms.llff(tmp_path) / "poses_bounds.npy"
    head = path.read_bytes().replace(b"(16, 17)", b"(9999999999, 17)", 1)
    for data in (b"", b"no array", head, b"\x93NUMPY\x01\x00v\x00{"):
        path.write_bytes(data)
        with pytest.raises(MiNtfError, match=r"poses_bounds.npy: cannot be read as an array of NumPy .*imgs2poses.py"):
            load(tmp_path)
    forms.llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "photographs")
    with pytest.raises(MiNtfError, match=r"images does not exist; put the photographs of .*poses_bounds.npy there"):
        load(tmp_path)


def test_a_folder_of_several_forms_says_so(tmp_path):
    """LLFF's own scenes come with the COLMAP model that their poses are from: the model says more."""
    forms.llff(forms.colmap(tmp_path))
    for path in (tmp_path / "images").glob("IMG*"):
        path.unlink()
    messages = load(tmp_path)[1].split("\n")
    assert messages[0].startswith("COLMAP model in ")
    assert messages[1] == "also in the folder, and ignored: LLFF data set (poses_bounds.npy)"
