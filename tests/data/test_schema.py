"""The pinhole camera and its axes."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_ntf.data import schema
from mi_ntf.data.schema import Split


def pose(position=(0.0, 0.0, 3.0)) -> np.ndarray:
    c2w = np.eye(4)
    c2w[:3, 3] = position
    return c2w


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


def test_focal_lengths_and_principal_point_of_each_camera():
    """The pixel centre at the principal point looks down -Z; one focal length further right or up, 45 degrees aside."""
    focal, principal = np.array([[2.0, 3.0], [1.0, 1.0]]), np.array([[1.5, 3.5], [0.5, 0.5]])
    _, d = schema.pixel_rays(np.stack([np.eye(4)] * 2), focal, 4, 5, principal)
    np.testing.assert_allclose(d[0, 3, 1], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(d[0, 3, 3], np.array([1, 0, -1]) / np.sqrt(2), atol=1e-15)
    np.testing.assert_allclose(d[0, 0, 1], np.array([0, 1, -1]) / np.sqrt(2), atol=1e-15)
    np.testing.assert_allclose(d[1, 0, 0], [0, 0, -1], atol=1e-15)


@given(st.lists(st.floats(-10, 10), min_size=16, max_size=16))
def test_camera_conversion_is_its_own_inverse_and_keeps_the_handedness(values):
    matrix = np.array(values).reshape(4, 4)
    there = schema.mitsuba_to_opengl(matrix)
    np.testing.assert_array_equal(schema.mitsuba_to_opengl(there), matrix)
    np.testing.assert_array_equal(there[:, [1, 3]], matrix[:, [1, 3]])  # up and position stay
    # two flipped axes keep the determinant; 1e-7 is 1e-10 of the largest product of three entries (10^3), for rounding
    assert np.linalg.det(there[:3, :3]) == pytest.approx(np.linalg.det(matrix[:3, :3]), abs=1e-7)


def split(dtype=np.float64) -> Split:
    shapes = {"images": (2, 4, 5, 4), "c2w": (2, 4, 4), "focal": (2, 2), "principal": (2, 2), "light_pos": (2, 3),
              "light_intensity": (2, 3), "center": (3,), "radius": ()}
    numbers = {k: np.random.default_rng(1).random(shape) for k, shape in shapes.items()}
    return Split(**numbers | {"images": (200 * numbers["images"]).astype(dtype)})


@pytest.mark.parametrize("dtype", [np.uint8, np.float16, np.float32])
def test_fingerprints_of_every_kind_of_pixels(dtype):
    """One level more, another type of the same numbers, and another meaning of alpha are other photographs."""
    one, other = split(dtype), split(dtype)
    other.images[1, 2, 3, 0] += 1
    hashes = [schema.fingerprint({"train": s}) for s in (one, split(dtype), other, split(np.float64),
                                                        dataclasses.replace(one, masked=False),
                                                        dataclasses.replace(one, names=("a", "b")))]
    assert hashes[1] == hashes[0] == hashes[5]
    for changed in hashes[2:5]:
        assert {k for k in changed if changed[k] != hashes[0][k]} == {"photographs or masks"}


@pytest.mark.parametrize(("name", "place", "kind"), [
    ("images", (1, 2, 3, 0), "photographs or masks"), ("images", (0, 0, 0, 3), "photographs or masks"),
    ("c2w", (1, 0, 3), "cameras"), ("focal", (0, 1), "cameras"), ("principal", (1, 0), "cameras"),
    ("light_pos", (0, 2), "lights"), ("light_intensity", (1, 1), "lights"), ("center", (1,), "the object's sphere"),
    ("radius", (), "the object's sphere")])
@pytest.mark.parametrize("split_name", ["train", "val"])
def test_fingerprints_tell_what_changed(split_name, name, place, kind):
    """The last bit of any number of any split changes the hash of its kind and no other."""
    one, other = ({"train": split(), "val": split()} for _ in range(2))
    before = schema.fingerprint(one)
    assert schema.fingerprint(other) == before
    values = np.array(getattr(other[split_name], name))
    values[place] = np.nextafter(values[place], 2)
    object.__setattr__(other[split_name], name, values)
    after = schema.fingerprint(other)
    assert {k for k in before if before[k] != after[k]} == {kind}
    moved = {"train": one["val"], "val": one["train"], "test": one["val"]}
    assert not set(schema.fingerprint(moved).values()) & set(before.values())
