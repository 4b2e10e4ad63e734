"""Fields that move: by their parameter ``to_world``, and by a parameter of a scene's file."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.infer.visibility import transmittance_atlas
from mi_ntf.render.maps import map_cache

LIGHTS = {"light": scenes.light("point"), "other": scenes.light("directional")}


def at(k: float) -> mi.ScalarTransform4f:
    """Return a rigid motion about the object's centre, and away from it."""
    centre = mi.ScalarPoint3f(scenes.SIMILARITY.center)
    move = mi.ScalarTransform4f().translate
    return move([0.4 * np.sin(0.1 * k), 0.005 * k, 0]) @ move(centre).rotate([0.6, 0.8, 0], 6 * k) @ move(-centre)


def placed(blobs, to_world, integrator: dict, **options):
    """Return the scene with field and bounding sphere moved by `to_world`."""
    ball = {**scenes.ball(blobs, to_world=to_world), "to_world": to_world}
    lights = options.pop("lights", LIGHTS)
    return scenes.scene(None, integrator, lights, shapes={"ball": ball}, **options)


def move(parameters: mi.SceneParameters, to_world: mi.ScalarTransform4f) -> None:
    """Move the field and its bounding sphere."""
    centre, radius = list(scenes.SIMILARITY.center), scenes.SIMILARITY.radius
    parameters["ball.interior_medium.to_world"] = mi.Transform4f(to_world)
    parameters["ball.to_world"] = mi.Transform4f(to_world @ mi.ScalarTransform4f().translate(centre).scale(radius))
    parameters.update()


@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_map", "transmittance_atlas"])
def test_a_field_that_has_moved_is_one_loaded_there(blobs, visibility):
    options = {"size": 16, "spp": 4}
    scene = placed(blobs, mi.ScalarTransform4f(), scenes.nrf(visibility), **options)
    before = scenes.render(scene)
    move(mi.traverse(scene), at(7))
    after = scenes.render(scene)
    np.testing.assert_allclose(after, scenes.render(placed(blobs, at(7), scenes.nrf(visibility), **options)), atol=1e-4)
    assert np.abs(after - before).max() > 0.1


def test_flags_and_bad_places(blobs):
    """A shear, and a field without its bounding shape, are refused as on loading."""
    scene = placed(blobs, mi.ScalarTransform4f(), scenes.nrf(), size=8, spp=1)
    parameters = mi.traverse(scene)
    key = "ball.interior_medium.to_world"
    assert parameters.flags(key) == parameters.flags("ball.to_world")
    np.testing.assert_array_equal(np.array(parameters[key].matrix).reshape(4, 4), np.eye(4))
    parameters[key] = mi.Transform4f(mi.ScalarTransform4f().translate([5, 0, 0]))
    parameters.update()
    with pytest.raises(MiNtfError, match="give shape and medium the same placement"):
        scenes.render(scene)
    parameters[key] = mi.Transform4f(mi.ScalarTransform4f().scale([1, 2, 1]))
    with pytest.raises((MiNtfError, RuntimeError), match="no similarity"):
        parameters.update()


@pytest.mark.parametrize("visibility", ["transmittance_map", "transmittance_atlas"])
def test_ntf_follows_its_field(blobs, visibility):
    """The shadow of a moved field is that of a field loaded there."""
    def loaded(to_world):
        medium = scenes.ball(blobs, to_world=to_world)["interior"]
        light = {"type": "ntf", "visibility": visibility, "light": scenes.light("point"), "medium": medium}
        return placed(blobs, to_world, {"type": "volpath", "max_depth": 2}, size=12, spp=16, lights={"light": light})

    scene = loaded(mi.ScalarTransform4f())
    media = [key for key in mi.traverse(scene).keys() if key.endswith("medium.to_world")]
    move(mi.traverse(scene), at(7))
    assert media == ["ball.interior_medium.to_world"]
    image, expected = scenes.render(scene), scenes.render(loaded(at(7)))
    assert relative_rmse(image, expected) < 0.02


def test_sixty_frames_build_and_compile_nothing(blobs, monkeypatch):
    """After the first two frames of a rigid motion nothing is built or compiled, and the error is that of a still."""
    made = []
    make = transmittance_atlas.TransmittanceMap
    monkeypatch.setattr(transmittance_atlas, "TransmittanceMap", lambda *a: made.append(0) or make(*a))
    scene = placed(blobs, at(0), scenes.nrf("transmittance_atlas"), size=16, spp=16)
    truth = placed(blobs, at(0), scenes.nrf("raymarch"), size=16, spp=16)
    errors, compiled = [], 0
    with map_cache.in_memory(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for k in range(60):
            move(mi.traverse(scene), at(k))
            dr.kernel_history_clear()
            image = scenes.render(scene)
            if k > 1:
                compiled += sum(not entry["cache_hit"] for entry in dr.kernel_history([dr.KernelType.JIT]))
            if k % 6 == 0:
                move(mi.traverse(truth), at(k))
                errors.append(relative_rmse(image, scenes.render(truth)))
    assert (len(made), compiled) == (1, 0)
    assert max(errors) < 0.03 and np.mean(errors) < 1.2 * errors[0]
