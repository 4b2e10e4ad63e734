"""The data set's format: rays, colours, round trips, and what the errors say."""

import json

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import schema


def pose(position=(0.0, 0.0, 3.0)) -> np.ndarray:
    c2w = np.eye(4)
    c2w[:3, 3] = position
    return c2w


def make_set(folder, count=2, w=6, h=4, change=None):
    """A small data set; `change` edits the JSON before it is written."""
    images = np.random.default_rng(0).uniform(size=(count, h, w, 4)).astype(np.float16).astype(np.float32)
    frames = []
    for i, image in enumerate(images):
        schema.write_exr(folder / f"{i}.exr", image)
        c2w = pose((0.0, 0.1 * i, 3.0))
        frames.append(schema.Frame(f"{i}.exr", c2w, c2w[:3, 3], np.array([1.0, 2.0, 3.0])))
    transforms = schema.Transforms(0.7, w, h, np.array([0.1, 0.2, 0.3]), 1.5, frames)
    path = schema.write_transforms(folder, "train", transforms)
    if change:
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))
    return images


def test_a_written_set_is_read_back_exactly(tmp_path):
    images = make_set(tmp_path)
    split = schema.load_split(tmp_path, "train")
    np.testing.assert_array_equal(split.images, images)  # the pixels were half floats before they were written
    np.testing.assert_array_equal(split.c2w[1], pose((0.0, 0.1, 3.0)))
    np.testing.assert_array_equal(split.light_intensity[0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(split.light_pos[1], [0.0, 0.1, 3.0], rtol=1e-7)  # float32
    assert split.radius == 1.5 and split.center.tolist() == [0.1, 0.2, 0.3]
    assert split.focal == pytest.approx(3.0 / np.tan(0.35))
    assert not list(tmp_path.glob("*.tmp*"))


def test_pixel_rays_of_a_camera_at_the_origin_are_the_pinhole_formula():
    origins, directions = schema.pixel_rays(np.eye(4), focal=2.0, w=4, h=2)
    assert origins.shape == directions.shape == (2, 4, 3)
    top_left = np.array([-1.5 / 2.0, 0.5 / 2.0, -1.0])  # left of the axis and above it, looking down -Z
    np.testing.assert_allclose(directions[0, 0], top_left / np.linalg.norm(top_left), atol=1e-15)
    np.testing.assert_allclose(directions[1, 3], -directions[0, 0] * (1, 1, -1), atol=1e-15)


def test_pixel_rays_of_many_cameras_are_those_of_each():
    c2w = np.stack([pose((0, 0, 3)), schema.mitsuba_to_opengl(pose((1, 2, 3)))])
    origins, directions = schema.pixel_rays(c2w, 5.0, 3, 2)
    for i in range(2):
        one = schema.pixel_rays(c2w[i], 5.0, 3, 2)
        np.testing.assert_array_equal(origins[i], one[0])
        np.testing.assert_allclose(directions[i], one[1], atol=1e-15)


@given(st.lists(st.floats(-10, 10), min_size=16, max_size=16))
def test_camera_conversion_is_its_own_inverse_and_keeps_the_handedness(values):
    matrix = np.array(values).reshape(4, 4)
    there = schema.mitsuba_to_opengl(matrix)
    np.testing.assert_array_equal(schema.mitsuba_to_opengl(there), matrix)
    np.testing.assert_array_equal(there[:, [1, 3]], matrix[:, [1, 3]])  # up and position stay
    # two flipped axes keep the determinant; 1e-7 is 1e-10 of the largest product of three entries (10^3), for rounding
    assert np.linalg.det(there[:3, :3]) == pytest.approx(np.linalg.det(matrix[:3, :3]), abs=1e-7)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 255), st.integers(0, 255))
def test_png_becomes_linear_and_premultiplied(tmp_path_factory, value, alpha):
    path = tmp_path_factory.mktemp("png") / "a.png"
    Image.fromarray(np.array([[[value, 255, 0, alpha]]], np.uint8), "RGBA").save(path)
    pixel = schema.read_image(path)[0, 0]
    s, a = value / 255, alpha / 255
    linear = s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(pixel, [linear * a, a, 0.0, a], atol=1e-6)  # float32


def test_exr_without_alpha_is_opaque(tmp_path):
    rgb = np.full((2, 3, 3), 0.25, np.float32)
    with OpenEXR.File({}, {"RGB": rgb}) as file:
        file.write(str(tmp_path / "a.exr"))
    pixels = schema.read_image(tmp_path / "a.exr")
    assert pixels.shape == (2, 3, 4) and (pixels[..., 3] == 1).all() and (pixels[..., :3] == 0.25).all()


def frame_edit(key, value):
    return lambda data: data["frames"][1].__setitem__(key, value)


@pytest.mark.parametrize(("change", "text"), [
    (lambda d: d.update(frames=[]), "'frames' is empty"),
    (frame_edit("transform_matrix", [[1, 0], [0, 1]]), r"frame 1: 'transform_matrix' has shape \(2, 2\), expected"),
    (frame_edit("transform_matrix", (2 * np.eye(4)).tolist()), "frame 1: 'transform_matrix' is no rigid motion"),
    (frame_edit("transform_matrix", np.diag([1.0, 1.0, -1.0, 1.0]).tolist()), "determinant -1"),
    (frame_edit("pl_pos", [0, float("nan"), 0]), r"frame 1: 'pl_pos' is not finite: \[0.0, nan, 0.0\]"),
    (frame_edit("pl_intensity", "bright"), "'pl_intensity' is 'bright', expected numbers"),
    (lambda d: d["frames"][0].pop("pl_pos"), "frame 0: 'pl_pos' or 'pl_intensity' is missing; training needs"),
    (frame_edit("file_path", "gone.exr"), "gone.exr does not exist; the data set is incomplete"),
    (lambda d: d.update(w=7), "1?0.exr: is 6x4, transforms_train.json says 7x4"),
    (lambda d: d.update(camera_angle_x=40.0), "'camera_angle_x' is 40, must be below pi; it is in radians"),
    (lambda d: d["unit_sphere"].update(radius=0), "unit_sphere: 'radius' is 0, must be positive"),
    (lambda d: d.pop("unit_sphere"), "unit_sphere: 'center' is missing"),
])
def test_a_broken_set_is_named_with_file_value_and_remedy(tmp_path, change, text):
    make_set(tmp_path, change=change)
    with pytest.raises(MiNtfError, match=text):
        schema.load_split(tmp_path, "train")


def test_broken_images_are_named(tmp_path):
    make_set(tmp_path)
    pixels = np.zeros((4, 6, 4), np.float32)
    pixels[1, 2, 0] = np.nan
    schema.write_exr(tmp_path / "1.exr", pixels)
    with pytest.raises(MiNtfError, match=r"1.exr: 1 pixels are NaN or infinite; delete it"):
        schema.load_split(tmp_path, "train")
    (tmp_path / "1.exr").write_bytes(b"no image")
    with pytest.raises(MiNtfError, match=r"1.exr: cannot be read as an image"):
        schema.load_split(tmp_path, "train")
    (tmp_path / "1.exr").rename(tmp_path / "1.jpg")
    with pytest.raises(MiNtfError, match=r"1.jpg: images of type '.jpg' are not read; convert it to .exr or .png"):
        schema.read_image(tmp_path / "1.jpg")


def test_missing_json_and_unknown_split(tmp_path):
    with pytest.raises(MiNtfError, match=r"transforms_val.json does not exist; make a data set with `mi-ntf capture"):
        schema.load_split(tmp_path, "val")
    with pytest.raises(MiNtfError, match="split 'validation' is unknown; it is one of train, val, test"):
        schema.load_split(tmp_path, "validation")
    (tmp_path / "transforms_val.json").write_text("{")
    with pytest.raises(MiNtfError, match=r"transforms_val.json: not valid JSON"):
        schema.load_split(tmp_path, "val")
