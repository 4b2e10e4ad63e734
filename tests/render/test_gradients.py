"""Derivatives of the image by the lights, against central differences over the same random numbers."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from helpers.derivatives import backward, differences, forward

from mi_ntf.core.errors import MiNtfError


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    # Soft enough that shadows move by many cells' worth of depth before they are gone.
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=2.0, roughness=0.6)


def setting(blobs, lights, visibility, **options):
    integrator = {"type": "nrf", "visibility": visibility, "hide_emitters": True, "samples": 256, **options}
    scene = scenes.scene(blobs, integrator, lights, size=12, spp=16)
    return scene, mi.traverse(scene)


@pytest.mark.parametrize("mode", [forward, backward])
@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_map"])
def test_intensity(blobs, visibility, mode):
    """The image is linear in the intensity, so only rounding differs."""
    scene, parameters = setting(blobs, {"light": scenes.light("point")}, visibility)
    case = scene, parameters, "light.intensity.value", [1.0, 0.5, 0.2], mi.Color3f
    assert mode(*case) == pytest.approx(differences(*case, 10.0), rel=1e-3)


@pytest.mark.parametrize("mode", [pytest.param(forward, marks=pytest.mark.slow), backward])
@pytest.mark.parametrize(("light_samples", "rel"), [(0, 0.01), (4, 0.05)])
def test_environment_texels(blobs, light_samples, rel, mode):
    """A patch of texels becomes brighter.

    In the exhaustive sum, cells and their centres move with it, which the derivative leaves out (0.1 % here). Sampled
    lights come from the old map in one picture and from new maps in the other (4 % noise).
    """
    lights = {"light": scenes.light("env")}
    scene, parameters = setting(blobs, lights, "raymarch", environment_lights=128, light_samples=light_samples)
    patch = np.zeros(parameters["light.data"].shape, np.float32)
    patch[3:9, 16:26] = [1.0, 0.8, 0.5]
    case = scene, parameters, "light.data", patch, mi.TensorXf
    assert mode(*case) == pytest.approx(differences(*case, 0.05), rel=rel)


def by_position(scene, parameters) -> tuple:
    """The derivative by the place of the light, along one direction."""
    return scene, parameters, "light.position", [-0.3, -0.6, 1.0], mi.Point3f


@pytest.fixture(scope="module")
def moved(blobs):
    """Function that returns the differences by the place of a point light, computed once for each visibility."""
    return cache(lambda visibility: differences(
        *by_position(*setting(blobs, {"light": scenes.light("point")}, visibility)), 0.1))


@pytest.mark.parametrize(("mode", "visibility"), [
    (forward, "raymarch"), *((backward, v) for v in ("raymarch", "neural_transmittance", "transmittance_map", "none")),
    *(pytest.param(forward, v, marks=pytest.mark.slow) for v in ("neural_transmittance", "transmittance_map", "none"))])
def test_position(blobs, moved, visibility, mode):
    """The light's distance, angle, shadows and the horizon, where the phase function jumps, move.

    Derivatives are the march's even with maps and networks. Differences depend on its steps: from 0.05 to 0.1 they vary
    by 1 %.
    """
    truth, unshadowed = moved("raymarch"), moved("none")
    assert abs(truth - unshadowed) > 0.5 * abs(truth)  # shadows matter here
    scene, parameters = setting(blobs, {"light": scenes.light("point")}, visibility)
    expected = unshadowed if visibility == "none" else truth
    assert mode(*by_position(scene, parameters)) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("other", ["field", "floor"])
def test_position_moves_shadows_on_other_things(blobs, other):
    """Shadows of one field on another, and of a field on a surface, move."""
    up = mi.ScalarTransform4f()
    if other == "floor":
        lying = up.translate([0.4, -1.8, 0.3]).rotate([1, 0, 0], -90).scale(6)
        shapes = {"floor": {"type": "rectangle", "to_world": lying}}
        aim = {"origin": [0.4, 2.5, 3.5], "target": [0.4, -1.8, -1.0]}
    else:
        away = [-3.9, -2.2, -2.4]
        shift = {"to_world": up.translate(away)}
        shapes = {"second": {**scenes.ball(blobs, **shift), "center": [0.4 + away[0], -0.2 + away[1], 0.3 + away[2]]}}
        aim = {"origin": [-3.5, -1.4, 2.5], "target": [-3.5, -2.4, -2.1]}
    values = []
    for visibility in ("raymarch", "none"):
        integrator = {"type": "nrf", "visibility": visibility, "hide_emitters": True, "samples": 256}
        scene = scenes.scene(blobs, integrator, {"light": scenes.light("point")}, size=12, spp=16, shapes=shapes)
        parameters = mi.traverse(scene)
        parameters["sensor.to_world"] = mi.Transform4f().look_at(**aim, up=[0, 1, 0])
        case = by_position(scene, parameters)
        values += [differences(*case, 0.1), backward(*case)]
    truth, slope, unshadowed, _ = values
    assert abs(truth - unshadowed) > 0.5 * abs(truth)
    assert slope == pytest.approx(truth, rel=0.05)


def test_many_moving_lights_are_refused(blobs):
    many = {f"light_{i}": {"type": "point", "position": [3, 3, i / 10], "intensity": 2.0} for i in range(33)}
    scene, parameters = setting(blobs, many, "raymarch")
    position = mi.Point3f(parameters["light_0.position"])
    dr.enable_grad(position)
    parameters["light_0.position"] = position
    parameters.update()
    with pytest.raises((MiNtfError, RuntimeError), match="33 lights, expected 32"):
        scene.integrator().render(scene)
