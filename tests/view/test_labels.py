"""Labels on a picture: names of the sides of a split, pointers to lights off view."""

import numpy as np
import pytest

from mi_ntf.view import labels
from mi_ntf.view.camera import Pose, fov_of_window

POSE = Pose((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 90.0)
GREY = np.full((100, 200, 3), 128, np.uint8)


@pytest.mark.parametrize(("position", "place"), [
    ((0, 0, 0), None), ((7.9, 0, 0), None), ((0, -3.9, 0), None), ((8.1, 0, 0), (1, 0)), ((-9, 0, 0), (-1, 0)),
    ((0, 5, 0), (0, -1)), ((4, -8, 0), (0.25, 1)), ((1, 0, 9), (1, 0)), ((0, -1, 9), (0, 1)), ((0, 0, 9), (0, 1))])
def test_points_off_view_have_a_place_on_the_edge(position, place):
    """The picture is twice as wide as high, and the camera looks along −z. The last three points are behind it."""
    found = labels.direction(position, POSE, 2.0)
    assert (found is None) if place is None else found == pytest.approx(place)


@pytest.mark.parametrize(("towards", "edge"), [
    ((1, 0.2), np.s_[:, -1]), ((-1, -0.5), np.s_[:, 0]), ((0.3, -1), np.s_[0]), ((-0.1, 1), np.s_[-2:]),
    ((1, 1), np.s_[-16:, -1])])
def test_a_pointer_reaches_the_edge(towards, edge):
    picture = labels.labelled(GREY, (200, 100), (), 0.5, {"0 point": np.array(towards)})
    assert (picture[edge] != GREY[edge]).any()
    assert (picture != GREY).any(-1).sum() > 200  # pixels of arrow and name
    assert (picture[40:60, 90:110] == 128).all()


@pytest.mark.parametrize(("fraction", "named"), [(0.5, (True, True)), (0.1, (False, True)), (0.95, (True, False))])
def test_both_sides_of_a_split_are_named(fraction, named):
    """A side that is too narrow for its name has none."""
    picture = labels.labelled(GREY, (200, 100), ("raymarch", "none"), fraction, {})
    changed = (picture != GREY).any((0, 2))
    line = round(200 * fraction)
    assert (changed[:line].any(), changed[line:].any()) == named


def test_coarse_pictures_have_labels_of_the_same_size_and_others_are_left_alone():
    coarse = labels.labelled(GREY[::4, ::4], (200, 100), ("raymarch", "none"), 0.5, {})
    assert np.array_equal(coarse, labels.labelled(GREY, (200, 100), ("raymarch", "none"), 0.5, {}))
    assert labels.labelled(GREY[::4, ::4], (200, 100), ("raymarch",), 0.5, {}).shape == (25, 50, 3)


def test_a_narrow_window_shows_the_whole_width_of_the_picture():
    assert fov_of_window(40.0, 1.5, 2.0) == pytest.approx(40.0)
    narrow = np.tan(np.radians(fov_of_window(40.0, 1.5, 0.5)) / 2)
    assert 0.5 * narrow == pytest.approx(1.5 * np.tan(np.radians(20.0)))
