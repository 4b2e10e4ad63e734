"""The sphere around the object, from each kind of evidence, and the flash's intensity."""

import numpy as np
import pytest
from data import forms

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import estimates, poses

N = forms.VIEWS
FOCAL, MIDDLE = np.full((N, 2), forms.FOCAL), np.full((N, 2), forms.SIZE / 2)
PICTURES, OPAQUE = forms.PICTURES, np.ones_like(forms.PICTURES)


def test_nearest_point_of_lines_is_their_common_point():
    rng = np.random.default_rng(0)
    point, d = np.array([1.0, -2.0, 3.0]), rng.normal(size=(5, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    np.testing.assert_allclose(poses.nearest_point(point + rng.normal(size=(5, 1)) * d, d), point, atol=1e-12)
    assert poses.nearest_point(rng.normal(size=(5, 3)), np.repeat(d[:1], 5, 0)) is None


def test_masks_that_are_off_centre_and_cut(tmp_path):
    """The scene moved, a third of each picture cut off together with a part of the object in 15 of 16."""
    move = np.array([30.0, -7.0, 4.0])
    c2w = forms.C2W.copy()
    c2w[:, :3, 3] += move
    there = estimates.find_sphere(PICTURES[:, :, 7:], c2w, FOCAL, MIDDLE - (7, 0), None)
    here = estimates.find_sphere(PICTURES, forms.C2W, FOCAL, MIDDLE, None)
    assert here[1] == there[1] == "from the masks' visual hull"
    for ((center, radius), _), offset in ((here, 0), (there, move)):
        for c, r in forms.SPHERES:
            assert np.linalg.norm(c + offset - center) + r <= radius
        assert radius < 1.2 * forms.true_bounds()[1]  # 24 pixels and 16 views leave that much


def test_points_without_masks():
    (center, radius), source = estimates.find_sphere(OPAQUE, forms.C2W, FOCAL, MIDDLE, forms.surface_points())
    assert source == "from the reconstructed points"
    true_center, true_radius = forms.true_bounds()
    # a tenth of the points are outliers 40 times as far; the median of the rest lies within the object
    assert np.linalg.norm(center - true_center) < 0.5 * true_radius and 0.8 < radius / true_radius < 1.5


def test_cameras_alone():
    (center, radius), source = estimates.find_sphere(OPAQUE, forms.C2W, FOCAL, MIDDLE, None)
    np.testing.assert_allclose(center, 0, atol=1e-12)  # all look at the origin from 3.2
    assert radius == pytest.approx(3.2 * np.sin(forms.ANGLE / 2)) and "from the cameras alone" in source


@pytest.mark.parametrize("pictures", [PICTURES, OPAQUE])
def test_parallel_cameras_do_not_tell_where_the_object_is(pictures):
    with pytest.raises(MiNtfError, match=r"all 16 cameras look in one direction, .*write 'unit_sphere'"):
        estimates.find_sphere(np.repeat(pictures[:1], N, 0), np.repeat(forms.C2W[:1], N, 0), FOCAL, MIDDLE, None)


def test_intensity_of_a_facing_wall_in_closed_form():
    """L = albedo/π · I/d² at d = 3 − 0.5; brighter glints, shadow and what is masked change nothing."""
    images = np.ones((2, 10, 10, 4), np.float32)
    images[..., :3] = np.array([0.4, 0.8, 0.2]) / np.pi * 7 / 2.5**2
    images[:, 0, :5] *= (5, 5, 5, 1)
    images[:, 9] *= (1e-4, 1e-4, 1e-4, 1)
    images[:, 8] = 0
    images[:, 0, 1:5] = images[:, 1, 1:5]
    lights = np.array([[0, 0, 3.0], [3.0, 0, 0]])
    assert estimates.find_intensity(images, lights, np.zeros(3), 1.0) == pytest.approx(7, rel=1e-6)  # float32 pixels
    images[..., :3] *= 3
    assert estimates.find_intensity(images, lights, np.zeros(3), 1.0) == pytest.approx(21, rel=1e-6)
