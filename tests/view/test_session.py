"""A session's pictures are those of a fresh scene with the same changes, and it renders no more than what changed."""

import dataclasses
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.viewed import DIRECTIONAL, ENVIRONMENT, POINT, SECOND, SPOT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.render.maps import map_cache
from mi_ntf.view.picture import Interrupted
from mi_ntf.view.session import Session

SAME = 2e-5
"""Relative RMSE: layers are added in another order, and kernels of the same loop are rounded as the compiler likes."""


def fresh(path, spp=1, seed=0, **define):
    return np.array(mi.render(mi.load_file(str(path), **define), spp=spp, seed=seed))


def session(path, **define):
    return Session(path, define, 32)


def test_a_moved_point_light_gives_the_picture_of_a_fresh_scene(scene):
    view = session(scene(POINT))
    before = view.preview().image
    view.lights[0].move([-2.0, 3.5, 3.0])
    other = scene(POINT.replace('x="3.4" y="3" z="2.5"', 'x="-2" y="3.5" z="3"'), name="moved.xml")
    truth = fresh(other)
    assert relative_rmse(before, truth) > 0.1
    assert relative_rmse(view.preview().image, truth) < SAME
    assert relative_rmse(view.refine().image, truth) < SAME


def test_layers_add_up_to_the_picture_of_all_lights(scene):
    path = scene(POINT, SPOT, DIRECTIONAL, SECOND)
    view = session(path)
    assert view._groups() == [(0,), (1,), (2,), (3,)]
    assert relative_rmse(view.preview().image, fresh(path)) < SAME


def test_each_kind_of_light_follows(scene):
    path = scene(POINT, SPOT, DIRECTIONAL, ENVIRONMENT)
    view = session(path)
    view.preview()
    point, spot, directional, sky = view.lights
    point.dim(0.5)
    spot.move([1.0, 4.0, 4.0])
    spot.point([-0.6, -4.2, -3.7])
    directional.point([1, -1, -1])
    sky.turn(70)
    sky.dim(2)
    changed = (path.read_text().replace("60, 50, 40", "30, 25, 20")
               .replace('origin="0, 4, 4" target="0.4, -0.2, 0.3"', 'origin="1, 4, 4" target="0.4, -0.2, 0.3"')
               .replace('x="-1" y="-1.2" z="-0.6"', 'x="1" y="-1" z="-1"'))
    up = " ".join(f'{axis}="{value!r}"' for axis, value in zip("xyz", map(float, sky.up), strict=True))
    changed = re.sub(r'(<rotate x="1" angle="20"/>)', rf'\1<rotate {up} angle="70"/>', changed)
    changed = changed.replace('<string name="filename" value="sky.exr"/>',
                              '<string name="filename" value="sky.exr"/><float name="scale" value="2"/>')
    other = path.with_name("changed.xml")
    other.write_text(changed)
    assert relative_rmse(view.preview().image, fresh(other)) < 1e-4  # the spot's up direction turns its frame


def test_the_camera_follows(scene):
    view = session(scene(POINT))
    view.look(dataclasses.replace(view.pose, origin=(-2.0, 1.0, 5.0)))
    up = ", ".join(map(repr, view.pose.up))
    text = view.path.read_text().replace('origin="1.6, 1.3, 5.3"', 'origin="-2, 1, 5"')
    target = ", ".join(map(repr, view.pose.target))
    text = text.replace('target="0.4, -0.2, 0.3" up="0, 1, 0"', f'target="{target}" up="{up}"')
    other = view.path.with_name("looked.xml")
    other.write_text(text)
    assert relative_rmse(view.preview().image, fresh(other)) < 1e-3  # edges: the camera's place is rounded otherwise


def test_passes_add_up(scene):
    view = session(scene(POINT))
    frames = [view.refine(2) for _ in range(3)]
    truth = np.mean([fresh(view.path, 2, seed) for seed in range(3)], axis=0)
    assert [f.samples for f in frames] == [2, 4, 6]
    assert relative_rmse(frames[-1].image, truth) < SAME
    view.lights[0].move([3.0, 3.0, 3.0])
    assert view.refine().samples == 1
    view.look(view.pose)
    assert view.refine().samples == 1


def test_only_the_layer_of_a_moved_light_is_rendered_and_its_map_alone_made(scene, monkeypatch):
    monkeypatch.setenv("MI_NTF_CACHE", "memory")
    map_cache.forget()
    map_sizes = []
    cached = map_cache.cached
    monkeypatch.setattr(map_cache, "cached", lambda name, make, count, *rest, **options: cached(
        name, lambda *values: (map_sizes.append(count), make(*values))[1], count, *rest, **options))
    view = session(scene(POINT, SECOND, ENVIRONMENT))
    view.preview()
    picture = view._previews[0]
    one, sky = 2 * 48**2, 2 * 16 * 48**2
    assert (picture.rendered, map_sizes) == ([(0,), (1,), (2,)], [one, one, sky])
    view.lights[1].move([-2.0, 2.5, 3.0])
    view.preview()
    assert (picture.rendered[3:], map_sizes[3:]) == ([(1,)], [one])
    view.look(dataclasses.replace(view.pose, origin=(-2.0, 1.0, 5.0)))
    view.preview()
    assert (picture.rendered[4:], map_sizes[4:]) == ([(0,), (1,), (2,)], [])


@pytest.mark.parametrize("visibility", ["transmittance_map", "raymarch"])
def test_nothing_is_compiled_when_camera_lights_and_environment_move(scene, visibility):
    view = session(scene(POINT, SPOT, DIRECTIONAL, ENVIRONMENT), visibility=visibility)

    def move(k):
        view.lights[0].move([3.0, 2.0 + 0.3 * k, 2.5])
        view.lights[0].dim(1 + 0.1 * k)
        view.lights[1].move([0.2 * k, 4.0, 4.0])
        view.lights[2].point([-1, -1.2, -0.1 * k])
        view.lights[3].turn(13.0 * k)
        view.preview()
        view.look(dataclasses.replace(view.pose, origin=(1.6, 1.3 + 0.2 * k, 5.3)))
        view.preview()
        view.preview(2)
        view.refine(1 + k % 2)

    move(1)
    move(2)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        move(3)
        move(4)
        history = dr.kernel_history()
    kernels = [k for k in history if k["type"] == dr.KernelType.JIT]
    assert len(kernels) > 50
    assert [k["hash"] for k in kernels if not k["cache_hit"]] == []


def test_lights_beyond_the_eighth_share_a_layer_until_they_move(scene):
    lights = [POINT.replace("3.4", f"{3.4 - 0.3 * i}") for i in range(11)]
    view = session(scene(*lights))
    assert view._groups()[-1] == (8, 9, 10)
    view.lights[9].move([0.0, 4.0, 3.0])
    image = view.preview().image
    assert view._groups()[-2:] == [(9,), (8, 10)]
    lights[9] = POINT.replace('x="3.4" y="3" z="2.5"', 'x="0" y="4" z="3"')
    assert relative_rmse(image, fresh(scene(*lights, name="many.xml"))) < SAME


def test_methods_side_by_side_and_their_error(scene):
    view = session(scene(POINT))
    view.choose(visibility="transmittance_map", second_visibility="none")
    frame = view.preview()
    by_map, without = frame.image, frame.right
    assert relative_rmse(without, fresh(view.path, visibility="none")) < SAME
    truth = fresh(view.path, visibility="raymarch")
    expected = [relative_rmse(i[..., :3], truth[..., :3]) for i in (by_map, without)]
    names, errors = zip(*view.error(), strict=True)
    assert names == frame.methods == ("transmittance_map", "none")
    assert errors == pytest.approx(expected, rel=1e-3)
    assert 0 < expected[0] < 0.1 < expected[1]


def test_a_picture_names_the_method_that_auto_took(scene):
    view = session(scene(POINT), visibility="auto")
    assert view.preview().methods[0] in ("auto: transmittance_atlas", "auto: raymarch")


@pytest.mark.parametrize(("window", "size"), [
    ((1000, 1000), (32, 32)), ((400, 1600), (16, 64)), ((20, 20), (20, 20)), ((30, 10), (30, 10))])
def test_pictures_have_the_shape_of_the_window_and_no_more_pixels(scene, window, size):
    view = session(scene(POINT))
    view.fit(*window)
    assert view.preview().image.shape[1::-1] == size


def test_other_outputs(scene):
    view = session(scene(POINT, SECOND))
    view.choose(aov="normal")
    image = view.preview().image
    is_hit = np.abs(image).max(-1) > 0
    assert image.shape == (32, 32, 3) and np.allclose(np.linalg.norm(image[is_hit], axis=-1), 1, atol=1e-5)
    view.choose(aov="depth")
    depth = view.refine().image[..., 0]
    assert 3 < depth[depth > 0].min() and depth.max() < 8  # the camera is 5.3 away


@pytest.mark.parametrize(("wrong", "text"), [
    ({"visibility": "map"}, 'visibility is "map", expected one of'), ({"aov": "motion"}, 'there is no "motion"')])
def test_unknown_names_are_told(scene, wrong, text):
    with pytest.raises(MiNtfError, match=text):
        session(scene(POINT)).choose(**wrong)


def test_other_cameras_are_told(scene):
    path = scene(POINT, name="orthographic.xml")
    path.write_text(path.read_text().replace('type="perspective"', 'type="orthographic"')
                    .replace('<float name="fov" value="28"/>', ""))
    with pytest.raises(MiNtfError, match="OrthographicCamera; mi-ntf view turns perspective and thinlens"):
        session(path)


def test_a_pass_ends_when_something_moves_and_leaves_nothing_behind(scene, monkeypatch):
    view = session(scene(POINT))
    truth = view.refine(1).image.copy()
    view.look(view.pose)
    view._finals[0].context.rays_in_flight = 512  # two chunks
    calls = []
    view.stop = lambda: calls.append(1) or len(calls) > 1
    with pytest.raises(Interrupted):
        view.refine()
    view.stop, view._finals[0].context.rays_in_flight = (lambda: False), 0
    assert relative_rmse(view.refine().image, truth) < SAME
