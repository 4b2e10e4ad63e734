"""Emitters whose sampling does not find all of their light: `mis_compensation` and a `sampling_weight` of 0."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.lights import environment, scene_lights

SEEDS = 4
FLOOR = {"type": "rectangle", "to_world": mi.scalar_rgb.ScalarTransform4f().translate([0.4, -1.5, 0.3])
         .rotate([1, 0, 0], -90).scale(4)}


def sky(**options) -> dict:
    """A bright spot on an even sky: half of the light lies below the mean."""
    image = np.full((16, 32, 3), 0.3, np.float32)
    image[4:6, 18:21] = 12
    return {"type": "envmap", "bitmap": mi.Bitmap(image), **options}


def renders(field, integrator, lights, spp, shapes=None, size=16):
    loaded = scenes.scene(field, integrator, lights, spp=spp, size=size, shapes=shapes)
    return [scenes.render(loaded, seed)[..., :3] for seed in range(SEEDS)]


@pytest.mark.parametrize("shapes", [None, {"floor": FLOOR}], ids=["alone", "floor"])
def test_sampled_lights_under_mis_compensation(blobs, shapes):
    """The light below the mean, which Mitsuba then leaves to BSDF samples, reaches fields all the same."""
    integrator = scenes.nrf(light_samples=4, samples=128)
    pictures = [renders(blobs, integrator, {"sky": sky(mis_compensation=on)}, 32, shapes) for on in (True, False)]
    ztest.check(*pictures, "mis_compensation", block=4)
    np.testing.assert_allclose(np.mean(pictures[0]), np.mean(pictures[1]), rtol=0.01)  # 0.79 without the cure


def test_wrapped_light_under_mis_compensation(blobs):
    """`ntf` under stock `path` lights surfaces by emitter samples alone."""
    def picture(on: bool):
        medium = {"type": "nrf", "filename": str(blobs)}
        light = {"type": "ntf", "light": sky(mis_compensation=on), "medium": medium}
        return renders(None, {"type": "path", "max_depth": 2, "hide_emitters": True}, {"sky": light}, 256,
                       {"floor": FLOOR})

    pictures = [picture(on) for on in (True, False)]
    ztest.check(*pictures, "ntf, mis_compensation", block=4)
    np.testing.assert_allclose(np.mean(pictures[0]), np.mean(pictures[1]), rtol=0.01)


def weightless() -> dict:
    """Lights of which those of weight 0 are a point, which is dark, and a sky and an area, which shine."""
    lamp = mi.ScalarTransform4f().look_at([2.5, 3.5, 1.5], list(scenes.SIMILARITY.center), [0, 0, 1]).scale(0.7)
    return {
        "dark": {**scenes.light("point"), "sampling_weight": 0.0},
        "sun": {**scenes.light("directional"), "irradiance": 1.0},
        "sky": {**sky(), "sampling_weight": 0.0},
        "lamp": {"type": "rectangle", "to_world": lamp,
                 "emitter": {"type": "area", "radiance": 6.0, "sampling_weight": 0.0}},
    }


@pytest.fixture(scope="module")
def by_volpath(blobs):
    """Function that returns the pictures by volpath, rendered once."""
    return cache(lambda: renders(blobs, {"type": "volpath", "max_depth": 2}, weightless(), 512, {"floor": FLOOR}))


@pytest.mark.parametrize("samples", [0, 3])
def test_sampling_weights_of_0_agree_with_volpath(blobs, by_volpath, samples):
    """A point of weight 0 is dark; a sky and an area, which scattered rays meet, shine."""
    ours = renders(blobs, {"type": "nrf", "visibility": "raymarch", "light_samples": samples, "samples": 512,
                           "environment_lights": 96}, weightless(), 64 if samples else 16, {"floor": FLOOR})
    theirs = by_volpath()
    ztest.check(ours, theirs, f"sampling_weight {samples}", block=4)
    np.testing.assert_allclose(np.mean(ours), np.mean(theirs), rtol=0.02)


def test_a_wrapped_light_needs_a_weight(blobs):
    medium = {"type": "nrf", "filename": str(blobs)}
    with pytest.raises(Exception, match="sampling_weight is 0, so that BSDF samples alone would find the light"):
        mi.load_dict({"type": "ntf", "light": {"type": "constant"}, "medium": medium, "sampling_weight": 0.0})


def test_environments_are_read_once(monkeypatch):
    """Until a parameter is assigned, neither checks nor cells read the texels again; then they do."""
    scene = mi.load_dict({"type": "scene", "sky": sky()})
    emitter = scene.emitters()[0]
    rows = scene_lights.Lights(scene).rows
    with monkeypatch.context() as patch:
        patch.setattr(environment, "image", None)
        assert (scene_lights.Lights(scene).rows.power == rows.power).all()
    parameters = mi.traverse(emitter)
    parameters["data"] = parameters["data"] * 2
    parameters.update()
    np.testing.assert_allclose(scene_lights.Lights(scene).rows.power.sum(0), 2 * rows.power.sum(0), rtol=1e-5)
    parameters["data"][3, 5, 1] = np.nan
    parameters.update()
    with pytest.raises(MiNtfError, match="1 texels of data are NaN"):
        scene_lights.Lights(scene)
