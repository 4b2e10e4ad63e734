"""Derivatives of the image by a field's density and reflectance, against central differences and closed forms."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes
from helpers.derivatives import backward, differences, forward

from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError

STEPS = {"log_density": 0.1, "albedo": 0.05, "roughness": 0.03, "specular": 0.03}
MEDIUM = "ball.interior_medium."


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    """A file of three balls, soft enough that a change of their density is seen."""
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=2.0, roughness=0.6)


def case(field, name, light="point", part=True, **options):
    """Scene, parameters, key, direction and type for the derivative by `name`; `part`: of half of the blocks alone."""
    integrator = scenes.nrf(**{"visibility": "raymarch", "samples": 256, "environment_lights": 16, **options})
    scene = scenes.scene(field, integrator, {"light": scenes.light(light)}, size=12, spp=16)
    parameters = mi.traverse(scene)
    places = np.array(parameters[MEDIUM + ("density_blocks" if name == "log_density" else "reflectance_blocks")])
    direction = np.zeros(parameters[MEDIUM + name].shape, np.float32)
    direction[places[:, 0] < np.median(places[:, 0]) if part else slice(None)] = 1
    return scene, parameters, MEDIUM + name, direction, mi.TensorXf


@pytest.mark.parametrize("name", ["albedo", "roughness", "specular"])
def test_reflectance(blobs, name):
    """Both modes agree with differences over the same random numbers."""
    this = case(blobs, name)
    expected = differences(*this, STEPS[name])
    assert abs(expected) > 1e-4
    assert backward(*this) == pytest.approx(expected, rel=5e-3)
    assert forward(*this) == pytest.approx(expected, rel=5e-3)


@pytest.fixture(scope="module")
def by_density(blobs):
    """Function that returns the derivative by the density from differences, the first time it is asked for."""
    return cache(lambda light, part: differences(*case(blobs, "log_density", light, part), STEPS["log_density"]))


@pytest.mark.parametrize(("light", "part"), [("point", True), ("point", False), ("env", False)])
def test_density(blobs, by_density, light, part):
    """Camera visibility and shadows change with the density."""
    assert backward(*case(blobs, "log_density", light, part)) == pytest.approx(by_density(light, part), rel=0.05)


def test_density_of_an_opaque_skin(tmp_path):
    """Camera and lamp see into the same skin: gain and loss nearly cancel, so errors of the march count more."""
    file = scenes.write_blobs(tmp_path / "opaque", log_density=5.0, roughness=0.6)
    this = case(file, "log_density", part=False)
    assert backward(*this) == pytest.approx(differences(*this, STEPS["log_density"]), rel=0.1)


def test_density_of_two_fields(blobs, tmp_path):
    """Each of two overlapping fields of different size dims the light of the other."""
    near = scenes.Similarity(tuple(c + o for c, o in zip(scenes.SIMILARITY.center, (0.5, 0.3, 0.4), strict=True)), 1.05)
    header, tensors = fields.blobs(scenes.CENTERS, scenes.RADII, similarity=near, log_density=2.0, roughness=0.6)
    field_file.save(tmp_path / "near.safetensors", header, tensors, np.float32)
    scene = scenes.scene(blobs, scenes.nrf(samples=256), {"light": scenes.light("point")}, size=12, spp=16,
                         shapes={"near": scenes.ball(tmp_path / "near.safetensors", near)})
    parameters = mi.traverse(scene)
    for shape in ("ball", "near"):
        key = f"{shape}.interior_medium.log_density"
        this = scene, parameters, key, np.ones(parameters[key].shape, np.float32), mi.TensorXf
        assert backward(*this) == pytest.approx(differences(*this, STEPS["log_density"]), rel=0.05)


def test_density_without_shadows(blobs):
    """The camera's visibility alone, where the estimate has little noise; shadows have the larger derivative."""
    this = case(blobs, "log_density", visibility="none")
    expected = differences(*this, STEPS["log_density"])
    assert backward(*this) == pytest.approx(expected, rel=0.02)
    assert forward(*this) == pytest.approx(expected, rel=0.02)


def test_density_through_a_map(blobs, by_density):
    """The derivative of a looked up shadow is that of the march, and left out where told."""
    expected = by_density("point", True)
    looked_up = backward(*case(blobs, "log_density", visibility="transmittance_map"))
    assert looked_up == pytest.approx(expected, rel=0.05)
    fixed = backward(*case(blobs, "log_density", visibility="transmittance_map", shadow_gradients="none"))
    assert abs(fixed - expected) > 0.3 * abs(expected)


def test_opacity_of_a_uniform_ball(tmp_path):
    """The opacity 1 − exp(−σ c) of a chord c changes by σ c exp(−σ c) with ln σ."""
    header, tensors = fields.uniform(1.5, similarity=scenes.SIMILARITY)
    field_file.save(tmp_path / "uniform.safetensors", header, tensors, np.float32)
    scene = scenes.scene(tmp_path / "uniform.safetensors", scenes.nrf("none"), {}, size=8, spp=64,
                         medium={"resolution": 32})
    parameters = mi.traverse(scene)
    values, key = mi.TensorXf(parameters[MEDIUM + "log_density"]), MEDIUM + "log_density"
    t = mi.Float(0)
    dr.enable_grad(t)
    parameters[key] = values + t
    parameters.update()
    image = mi.render(scene, parameters)
    opacity = np.array(dr.detach(image))[3:5, 3:5, 3]
    dr.forward(t)
    slope = np.array(dr.grad(image))[3:5, 3:5, 3]
    depth = -np.log(1 - opacity)  # the pixels in the middle of the picture have all but one chord
    np.testing.assert_allclose(slope, depth * np.exp(-depth), rtol=0.02)


def test_what_is_set_is_what_is_seen(blobs):
    """Values that are set and set back give the first picture; each density has maps of its own, each colour not."""
    scene, parameters, key, direction, kind = case(blobs, "log_density", visibility="transmittance_map")
    first, medium = scenes.render(scene), scene.shapes()[0].interior_medium()
    digest, original = medium.field.digest, kind(parameters[key])
    parameters[key] = original + kind(direction)
    parameters.update()
    assert medium.field.digest != digest
    denser = scenes.render(scene)
    assert denser[..., 3].sum() > 1.01 * first[..., 3].sum()
    parameters[key] = original
    parameters.update()
    np.testing.assert_allclose(scenes.render(scene), first, atol=2e-3)  # the hull of the map is a little larger
    digest, colour = medium.field.digest, mi.TensorXf(parameters[MEDIUM + "albedo"])
    parameters[MEDIUM + "albedo"] = colour * 2
    parameters.update()
    assert medium.field.digest == digest
    assert scenes.render(scene)[..., :3].sum() > 1.2 * first[..., :3].sum()


@pytest.mark.parametrize(("name", "options", "text"), [
    ("albedo", {"max_depth": 3}, "albedo of a field.*max_depth above 2"),
    ("log_density", {"unbiased": True, "visibility": "transmittance_map"}, "unbiased"),
    ("albedo", {"aovs": "depth"}, "with aovs"), ("normal", {}, "normal: not supported")])
def test_what_derivatives_leave_out_is_refused(blobs, name, options, text):
    """Each refusal names the parameter and what does not go with it."""
    scene, parameters, key, _, kind = case(blobs, name, **options)
    values = kind(parameters[key])
    dr.enable_grad(values)
    parameters[key] = values
    parameters.update()
    with pytest.raises((MiNtfError, RuntimeError), match=text):
        scene.integrator().render(scene)


def test_networks_do_not_know_a_density_that_is_set(blobs):
    """Methods of trained networks refuse a field whose density was set."""
    scene, parameters, key, direction, kind = case(blobs, "log_density", visibility="neural_transmittance")
    parameters[key] = kind(parameters[key]) + kind(direction)
    parameters.update()
    with pytest.raises((MiNtfError, RuntimeError), match="density was set"):
        scenes.render(scene)


def test_a_tensor_of_another_shape_is_refused(blobs):
    """The sentence names the parameter and both shapes."""
    _, parameters, key, _, kind = case(blobs, "log_density")
    parameters[key] = kind(np.zeros((2, 3), np.float32))
    with pytest.raises((MiNtfError, RuntimeError), match=r"log_density was set to a tensor of shape \(2, 3\)"):
        parameters.update()


def test_stock_prbvolpath_agrees(blobs):
    """A z-test at 4 standard deviations between this integrator and Mitsuba's on the same field.

    Both parameters are attached at once: Dr.Jit ends the process on a second kernel of derivatives of `prbvolpath`.
    """
    names, found = ["albedo", "log_density"], []
    stock = {"type": "prbvolpath", "max_depth": 2}
    for integrator, samples, seeds in [(scenes.nrf(samples=256), 16, 3), (stock, 64, 6)]:
        scene = scenes.scene(blobs, integrator | {"hide_emitters": True}, {"light": scenes.light("point")}, size=12,
                             spp=samples)
        parameters, slopes = mi.traverse(scene), []
        original = {name: mi.TensorXf(parameters[MEDIUM + name]) for name in names}
        for seed in range(seeds):
            shifts = {name: mi.Float(0) for name in names}
            for name, shift in shifts.items():
                dr.enable_grad(shift)
                parameters[MEDIUM + name] = original[name] + shift
            parameters.update()
            image = mi.render(scene, parameters, seed=seed, seed_grad=seed + 100)[..., :3]
            dr.backward(dr.mean(image, axis=None))
            slopes.append([float(dr.grad(shift)[0]) for shift in shifts.values()])
            for name in names:
                parameters[MEDIUM + name] = original[name]
            parameters.update()
        found.append((np.mean(slopes, 0), np.std(slopes, axis=0, ddof=1) / seeds**0.5))
    (ours, our_error), (theirs, their_error) = found
    assert (np.abs(ours - theirs) < 4 * np.hypot(our_error, their_error)).all(), (found, names)
    assert (np.abs(theirs) > 4 * their_error).all()
