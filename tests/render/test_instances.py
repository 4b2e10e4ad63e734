"""Instances of ordinary shapes beside a field, fields in groups, and ``nrf`` inside other integrators."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.visibility import transmittance_atlas
from mi_ntf.render.maps import map_cache
from mi_ntf.render.scene.media import find_media, ordinary_shapes

PLACES = [(1.4, 1.1, 1.3), (0.3, 0.9, 1.6), (-0.9, 0.6, 1.4)]
BSDF = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}}


def ball(**more) -> dict:
    return {"type": "sphere", "radius": 0.3, "bsdf": BSDF, **more}


def instances() -> dict:
    """Return a group of a ball, which is invisible itself, and an instance at each of the places."""
    move = mi.ScalarTransform4f().translate
    at = {f"at_{i}": {"type": "instance", "to_world": move(p), "group": {"type": "ref", "id": "group"}}
          for i, p in enumerate(PLACES)}
    return {"group": {"type": "shapegroup", "ball": ball()}, **at}


def written_out() -> dict:
    return {f"at_{i}": ball(center=p) for i, p in enumerate(PLACES)}


def scene(blobs, integrator: dict, shapes: dict, **options):
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse"},
             "to_world": mi.ScalarTransform4f().translate([0.4, -1.8, 0.3]).rotate([1, 0, 0], -90).scale(4)}
    shapes = {"floor": floor, **shapes}
    return scenes.scene(blobs, integrator, {"light": scenes.light("point")}, shapes=shapes, **options)


@pytest.mark.parametrize("options", [{}, {"max_depth": 4}, {"max_error": 0.05, "visibility": "auto"}])
def test_instances_are_what_is_written_out(blobs, options):
    """Instances hide the field, cast shadows on it and the floor, and reflect."""
    pictures = [
        scenes.render(scene(blobs, scenes.nrf(**options), shapes, size=16, spp=16))
        for shapes in (instances(), written_out(), {})
    ]
    assert ztest.block_difference(pictures[2], pictures[1], 4).max() > 0.2  # they show
    assert ztest.block_difference(pictures[0], pictures[1], 4).max() < 0.01
    np.testing.assert_allclose(pictures[0].mean((0, 1)), pictures[1].mean((0, 1)), rtol=0.002)


@pytest.mark.parametrize("depth", [2, 4])
def test_instances_beside_stock_volpath(blobs, depth):
    ours = scene(blobs, scenes.nrf(max_depth=depth), instances(), size=16)
    theirs = scene(blobs, {"type": "volpath", "max_depth": depth, "rr_depth": 100}, instances(), size=16)
    images = [[scenes.render(s, seed, spp)[..., :3] for seed in range(4)] for s, spp in ((ours, 32), (theirs, 512))]
    ztest.check(*images, f"instances {depth}", block=2)
    np.testing.assert_allclose(np.mean(images[0], (0, 1, 2)), np.mean(images[1], (0, 1, 2)), rtol=0.02)


def grouped(blobs, place=(0, 0, 0), **more) -> dict:
    """Return a group with the field, and an instance of it."""
    move = mi.ScalarTransform4f().translate
    return {"group": {"type": "shapegroup", "inner": scenes.ball(blobs), **more},
            "at": {"type": "instance", "to_world": move(place), "group": {"type": "ref", "id": "group"}}}


@pytest.mark.parametrize("options", [{}, {"max_depth": 4}])
def test_a_field_in_a_group_is_what_is_written_out(blobs, options):
    images = [scenes.render(scene(field, scenes.nrf(**options), shapes, size=16, spp=16))
              for field, shapes in ((None, grouped(blobs)), (blobs, {}))]
    np.testing.assert_array_equal(*images)


def turned(i: int) -> mi.ScalarTransform4f:
    """Return one of several places of the object, some of which overlap."""
    return mi.ScalarTransform4f().translate([0.5 * i - 0.7, 0.3 * i, -0.4 * i]).rotate([0, 1, 0], 50 * i).scale(0.9**i)


def instanced(blobs, count: int) -> dict:
    at = {f"at_{i}": {"type": "instance", "to_world": turned(i), "group": {"type": "ref", "id": "group"}}
          for i in range(count)}
    return {"group": {"type": "shapegroup", "inner": scenes.ball(blobs)}, **at}


def loaded(blobs, count: int) -> dict:
    """Return a bounding sphere and a medium for each place."""
    return {f"at_{i}": scenes.ball(blobs, to_world=turned(i)) | {"to_world": turned(i)} for i in range(count)}


@pytest.mark.parametrize("options", [{}, {"visibility": "transmittance_map"}, {"max_depth": 4, "bounces": "paths"}])
def test_instances_of_a_field_are_fields_loaded_there(blobs, options):
    images = [scenes.render(scene(None, scenes.nrf(**options), shapes(blobs, 3), size=16, spp=16))
              for shapes in (instanced, loaded)]
    np.testing.assert_allclose(*images, atol=1e-4)


def test_instances_share_their_field_and_its_atlas(blobs, monkeypatch):
    """The density is one object, and one atlas serves all."""
    made = []
    make = transmittance_atlas.TransmittanceMap
    monkeypatch.setattr(transmittance_atlas, "TransmittanceMap", lambda *a: made.append(0) or make(*a))
    several = scene(None, scenes.nrf("transmittance_atlas"), instanced(blobs, 3), size=8, spp=1)
    assert len({id(medium.source) for medium in find_media(several)}) == 1 and len(find_media(several)) == 3
    with map_cache.in_memory():
        scenes.render(several)
    assert len(made) == 1


def test_an_instance_and_its_field_outside_are_two_fields(blobs):
    """Mitsuba merges the media of the same text."""
    media = find_media(scene(blobs, scenes.nrf(), grouped(blobs, (2.5, 0, 0))))
    np.testing.assert_allclose(media[1].frame.origin - media[0].frame.origin, [2.5, 0, 0], atol=1e-6)


def test_instances_that_move(blobs):
    """Instances have their place as a parameter in Mitsuba."""
    moved = scene(None, scenes.nrf(), instanced(blobs, 2), size=16, spp=4)
    parameters = mi.traverse(moved)
    parameters["at_1.to_world"] = mi.Transform4f(turned(2))
    parameters.update()
    expected = {key: value for key, value in instanced(blobs, 3).items() if key != "at_1"}
    images = [scenes.render(each) for each in (moved, scene(None, scenes.nrf(), expected, size=16, spp=4))]
    np.testing.assert_allclose(*images, atol=1e-4)


def test_a_group_of_a_field_and_a_ball_is_refused(blobs):
    with pytest.raises(MiNtfError, match=r'"inner" bounds an nrf medium in a shapegroup, beside other shapes.*give'):
        find_media(scene(None, scenes.nrf(), grouped(blobs, ball=ball(center=PLACES[1]))))


def test_another_medium_in_a_group_is_refused(blobs):
    group = {"group": {"type": "shapegroup", "fog": ball(bsdf={"type": "null"}, interior={"type": "homogeneous"})},
             "at": {"type": "instance", "group": {"type": "ref", "id": "group"}}}
    with pytest.raises(MiNtfError, match=r'"fog" bounds a medium inside a shapegroup.*take the'):
        ordinary_shapes(scene(blobs, scenes.nrf(), group))


@pytest.mark.parametrize("outer", [{"type": "aov", "aovs": "d:depth"}, {"type": "moment"}])
def test_nrf_inside_another_integrator_is_refused(blobs, outer):
    loaded = scene(blobs, {**outer, "inner": scenes.nrf()}, {}, size=4)
    with pytest.raises((MiNtfError, RuntimeError)) as caught:
        mi.render(loaded, spp=1)
    assert "cannot stand inside another one, such as aov or moment" in str(caught.value)
