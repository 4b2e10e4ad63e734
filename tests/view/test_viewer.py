"""The loop of a view: the resolution follows the time of previews, and the page tells what is shown."""

import time

import numpy as np
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.view.camera import Pose
from mi_ntf.view.session import Frame
from mi_ntf.view.viewer import FAST, REST, SLOW, Viewer


class Renderer:
    """Session whose previews take `overhead` seconds, and `seconds` more for 512² pixels."""

    aov, refined = "", False
    size = 512, 512
    pose = Pose((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0)

    def __init__(self, overhead=0.0, seconds=0.0):
        self.overhead, self.seconds = overhead, seconds
        self.edges, self.times = [], []

    def preview(self, divisor):
        self.edges.append(round(512 / divisor))
        self.times.append(self.overhead + self.seconds / divisor**2)
        return Frame(np.zeros((6, 8, 4)), self.times[-1], 1, ("auto: raymarch",))

    def refine(self, spp):
        self.edges.append("refined")
        return Frame(np.zeros((6, 8, 4)), 5.0, spp, ("auto: raymarch",))


def drag(viewer, previews=20, kind="camera"):
    for _ in range(previews):
        viewer.change("moved", lambda: None, kind)
        viewer.step()


@pytest.mark.parametrize(("overhead", "seconds"), [
    (0.06, 0.5), (0.0, 0.15), (0.0, 0.5), (0.0, 3.0), (0.0, 0.05), (0.15, 0.1), (0.05, 8.0)])
def test_the_resolution_settles_where_previews_are_neither_slow_nor_needlessly_coarse(overhead, seconds):
    renderer = Renderer(overhead, seconds)
    drag(Viewer(renderer, lambda *_: None, print))
    assert len(set(renderer.edges[-6:])) == 1
    assert renderer.times[-1] <= SLOW
    assert renderer.times[-1] >= FAST or renderer.edges[-1] == 512


@pytest.mark.parametrize("kind", ["camera", "light", "other"])
def test_the_resolution_rises_again_when_previews_are_fast(kind):
    renderer = Renderer(seconds=6.0)
    viewer = Viewer(renderer, lambda *_: None, print)
    drag(viewer, kind=kind)
    assert renderer.edges[-1] < 128
    renderer.seconds = 0.05
    drag(viewer, kind=kind)
    assert renderer.edges[-1] == 512


def test_a_single_slow_preview_changes_nothing():
    """A single slow preview may have compiled kernels."""
    renderer = Renderer(overhead=0.1)
    viewer = Viewer(renderer, lambda *_: None, print)
    for renderer.overhead in (0.1, 1.0, 0.1, 1.0, 0.1):
        drag(viewer, previews=1)
    assert set(renderer.edges) == {256}


@pytest.mark.parametrize(("kind", "edges"), [("camera", [256, 512, "refined"]), ("other", [512, "refined"])])
def test_a_coarse_picture_is_followed_by_a_preview_of_full_size(kind, edges):
    """A first pass of all lights may take seconds."""
    renderer = Renderer(overhead=0.1)
    viewer = Viewer(renderer, lambda *_: None, print)
    drag(viewer, previews=1, kind=kind)
    assert not viewer.step()  # something may still move
    time.sleep(REST)
    for _ in edges[1:]:
        viewer.step()
    assert renderer.edges == edges


def test_the_page_tells_size_samples_time_and_method():
    shown = []
    drag(Viewer(Renderer(overhead=0.069), lambda *what: shown.append(what), print), previews=1)
    assert shown[0][1] == "8×6, 1 sample a pixel, 69 ms\nauto: raymarch"
    assert shown[0][0].shape == (6, 8, 3)


def test_the_picture_points_to_lights_off_view():
    shown, lights = [], {"0 point": np.array([0.0, 0.0, 0.0])}
    viewer = Viewer(Renderer(), lambda picture, _: shown.append(picture), print, lights=lambda: lights)
    drag(viewer, previews=1)
    lights["0 point"] = np.array([9.0, 0.0, 0.0])
    drag(viewer, previews=1)
    assert not shown[0].any()
    assert shown[1].shape == (512, 512, 3) and shown[1][:, -60:].any() and not shown[1][:, :-60].any()


def test_a_refused_action_leaves_the_picture():
    """Such as saving under a name that exists; the other changes are made."""
    def refuse():
        raise MiNtfError("it exists")

    told, shown, done = [], [], []
    viewer = Viewer(Renderer(), lambda picture, _: shown.append(picture), told.append)
    drag(viewer, previews=1)
    viewer.change("save", refuse, "shown")
    viewer.change("exposure", lambda: done.append(1), "shown")
    viewer.step()
    assert done == [1] and len(shown) == 2 and "Error: it exists" in told
