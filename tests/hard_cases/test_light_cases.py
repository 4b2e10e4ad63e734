"""Lights where and as nobody expects them: inside, on and far from a field, dark and blinding, heaped, needle-thin and
wide open, lamps around and within the object; and what can and cannot be differentiated by."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import emitters, scenes, ztest
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.lights import scene_lights

CENTER, RADIUS = np.array(scenes.SIMILARITY.center), scenes.SIMILARITY.radius
METHODS = ["raymarch", "transmittance_map", "ray_network", "transmittance_volume", "visibility_mlp", "none"]
TOWARDS = np.array([0.6, 0.64, 0.48])


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0, visibility=True)


def picture(field, method: str, light: dict, spp=4, size=12, **options) -> np.ndarray:
    """Return a picture, (size, size, 3)."""
    options = {"map_resolution": 32, "samples": 192, **options}
    many = light if "type" not in light else {"light": light}
    return scenes.render(scenes.scene(field, scenes.nrf(method, **options), many, size=size, spp=spp))[..., :3]


def point(where, power) -> dict:
    return {"type": "point", "position": np.asarray(where).tolist(), "intensity": {"type": "rgb", "value": [power] * 3}}


@pytest.mark.parametrize("method", METHODS)
def test_far_dark_blinding_and_heaped(blobs, method):
    """A point 10⁵ radii off is a directional light; light is additive up to where floats end."""
    sun = {"type": "directional", "direction": (-TOWARDS).tolist(), "irradiance": 1.0}
    base = picture(blobs, method, sun)
    assert base.max() > 0.02
    far = 1e5 * RADIUS
    # float32 places the light within 1e-7 of its direction; maps of points are of another projection (1 %).
    rough = {"rtol": 0.03, "atol": 0.01 * base.max()} if "transmittance_" in method else {"rtol": 1e-3, "atol": 1e-5}
    np.testing.assert_allclose(picture(blobs, method, point(CENTER + far * TOWARDS, far**2)), base, **rough)
    assert (picture(blobs, method, {**sun, "irradiance": 0.0}) == 0).all()
    np.testing.assert_allclose(picture(blobs, method, {**sun, "irradiance": 1e37}) / 1e37, base, rtol=1e-4, atol=1e-6)
    near = point(CENTER + 1.5 * RADIUS * TOWARDS, 1.0)
    heap = {f"light_{i}": {**near, "intensity": 1 / 64} for i in range(64)}
    np.testing.assert_allclose(picture(blobs, method, heap), picture(blobs, method, near), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("where", ["gap", "sphere", "matter"])
def test_lights_inside_and_on_the_sphere(blobs, where):
    """Every method within 15 % of the march where light is seen, and finite; in matter all but nothing is."""
    at = {"gap": [0.75, -0.35, -0.1], "sphere": TOWARDS, "matter": [-0.3, 0.05, 0.0]}[where]
    light = point(CENTER + RADIUS * np.array(at), 1.0)
    march = picture(blobs, "raymarch", light, spp=16)
    free = picture(blobs, "none", light, spp=16)
    assert np.isfinite(free).all() and (free >= 0).all()
    if where != "matter":
        assert march.max() > 0.05 * free.max()
    for method in ("transmittance_map", "transmittance_volume"):
        found = picture(blobs, method, light, spp=16, map_resolution=128)
        assert np.isfinite(found).all() and (found >= 0).all(), method
        if where != "matter":
            error = np.sqrt(((found - march) ** 2).mean() / (march**2).mean())
            assert error < 0.15, (method, error)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["gap", "sphere"])
def test_lights_inside_and_on_the_sphere_equal_volpath(blobs, where):
    at = {"gap": [0.75, -0.35, -0.1], "sphere": TOWARDS}[where]
    light = {"light": point(CENTER + RADIUS * np.array(at), 1.0)}
    ours = scenes.scene(blobs, scenes.nrf(samples=512), light, size=12, spp=16)
    theirs = scenes.scene(blobs, {"type": "volpath", "max_depth": 2, "hide_emitters": True}, light, size=12, spp=256)
    images = [[scenes.render(s, seed)[..., :3] for seed in range(4)] for s in (ours, theirs)]
    ztest.check(*images, where, block=3)


@pytest.mark.parametrize("kind", ["point", "constant", "envmap", "area"])
@pytest.mark.parametrize("light_samples", [0, 2])
def test_blinding_lights_stay_finite(blobs, kind, light_samples):
    """10³⁶ times a light is 10³⁶ times its picture, summed and drawn."""
    weak, strong = (
        {
            "point": lambda p: point(CENTER + 2 * RADIUS * TOWARDS, p),
            "constant": lambda p: {"type": "constant", "radiance": p},
            "envmap": lambda p: {**scenes.light("env"), "scale": p},
            "area": lambda p: lamp_around(p),
        }[kind](power)
        for power in (1.0, 1e36)
    )
    options = {"light_samples": light_samples, "environment_lights": 16}
    a, b = (picture(blobs, "raymarch", light, size=8, **options) for light in (weak, strong))
    assert np.isfinite(b).all() and a.max() > 0.01
    np.testing.assert_allclose(b / 1e36, a, rtol=1e-3, atol=1e-6)


def rows_and_samples(description: dict, p: np.ndarray):
    """Irradiance (3, n) at the scene points (3, n): of the table's row, and by Mitsuba's own sampling."""
    loaded = mi.load_dict(description)
    row = scene_lights.rows([(loaded, description["type"])], 1)
    it = dr.zeros(mi.Interaction3f, p.shape[1])
    it.p = mi.Point3f(*p.astype(np.float32))
    _, wanted = loaded.sample_direction(it, mi.Point2f(0.5), True)
    if not len(row.power):
        return np.zeros_like(p), np.array(wanted)
    d = p - row.where.T
    distance = np.linalg.norm(d, axis=0)
    _, _, _, begin, end = row.cones[0]
    angle = np.arccos(np.clip(row.cones[0, :3] @ d / distance, -1, 1))
    share = np.clip((end - angle) / max(end - begin, 1e-6), 0, 1)
    return row.power.T / distance**2 * share, np.array(wanted)


@pytest.mark.parametrize(("cutoff", "beam"), [(0.0, 0.0), (0.01, 0.005), (0.5, 0.5), (89.9, 60.0), (90.0, 90.0)])
def test_spots_of_any_width(cutoff, beam, rng):
    aim = mi.ScalarTransform4f().look_at([2, 1, 3], [0, 0, 0.5], [0, 1, 0])
    description = {
        "type": "spot", "to_world": aim, "cutoff_angle": cutoff, "beam_width": beam, "intensity": 7.0
    }  # fmt: skip
    local = rng.normal(size=(3, 500))
    local[:, 250:] = np.array([[0], [0], [1]]) + 2e-4 * rng.normal(size=(3, 250))  # beside the axis
    world = np.array(aim.matrix)[:3, :3] @ local + np.array([[2], [1], [3]])
    ours, theirs = rows_and_samples(description, world)
    # The ramp divides angles, which float32 cosines know to 3e-4 at the axis, by its width.
    edge = 4e-4 / max(np.radians(cutoff - beam), 4e-4)
    wrong = np.abs(ours - theirs).max(axis=0) > 1e-4 * theirs.max() + edge * np.maximum(ours, theirs).max(axis=0)
    assert wrong.mean() < 0.01  # points on the rim itself
    assert (theirs.max() > 0) == (ours.max() > 0)


def lamp_around(radiance) -> dict:
    """A ball around everything, the camera included, that shines inwards."""
    return {
        "type": "sphere",
        "center": CENTER.tolist(),
        "radius": 40.0,
        "flip_normals": True,
        "emitter": {"type": "area", "radiance": radiance},
    }


def block_error(a: np.ndarray, b: np.ndarray) -> float:
    return float(ztest.block_difference(a, b, size=4).max())


def test_area_light_around_the_object_is_an_even_sky(blobs):
    lit = picture(blobs, "raymarch", {"ball_of_light": lamp_around(0.7)}, spp=256)
    sky = picture(blobs, "raymarch", {"type": "constant", "radiance": 0.7}, spp=256, environment_lights=64)
    assert block_error(lit, sky) < 0.04  # noise of two drawn lights a point: 0.017 to 0.033 with six seeds


def test_small_area_light_within_the_object_is_a_point(blobs):
    """A ball of radiance L and radius r has the intensity π r² L."""
    at, r = CENTER + RADIUS * np.array([0.75, -0.35, -0.1]), 0.01
    ball = {"type": "sphere", "center": at.tolist(), "radius": r, "emitter": {"type": "area", "radiance": 1 / r**2}}
    lit = picture(blobs, "raymarch", {"lamp": ball}, spp=64)
    assert block_error(lit, picture(blobs, "raymarch", point(at, np.pi), spp=64)) < 0.04


@pytest.mark.parametrize("parameter", ["position", "intensity.value"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_lights_that_are_no_numbers(blobs, parameter, value):
    scene = scenes.scene(blobs, scenes.nrf(), {"lamp": point([3, 3, 3], 1.0)}, size=4, spp=1)
    parameters = mi.traverse(scene)
    kind = type(parameters[f"lamp.{parameter}"])
    parameters[f"lamp.{parameter}"] = kind(1, value, 2)
    parameters.update()
    with pytest.raises(MiNtfError, match=rf"point emitter \(lamp\): 1 numbers of {parameter} are NaN or infinite"):
        scene.integrator().render(scene)


@pytest.mark.parametrize("light_samples", [0, 2])
def test_negative_light_subtracts(blobs, light_samples):
    """Mitsuba's own integrators do the same."""
    two = {"a": point(CENTER + 2 * RADIUS * TOWARDS, 9.0), "b": point(CENTER + 2 * RADIUS * TOWARDS, -4.0)}
    found = picture(blobs, "raymarch", two, spp=256, light_samples=light_samples)
    wanted = picture(blobs, "raymarch", {"a": point(CENTER + 2 * RADIUS * TOWARDS, 5.0)}, spp=256)
    # Of two lights in one place, drawn with even chances: noise of 0.028 to 0.063 with six seeds.
    assert block_error(found, wanted) < (0.08 if light_samples else 1e-4)


def attached(scene, key: str):
    """The parameters of `scene` with gradients on `key`."""
    parameters = mi.traverse(scene)
    value = parameters[key]
    value = mi.Transform4f(value.matrix) if "to_world" in key else type(value)(value)
    dr.enable_grad(value)
    parameters[key] = value
    parameters.update()
    return parameters


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("kind", "key", "options"),
    [
        ("spot", "light.cutoff_angle", {}),
        ("spot", "light.beam_width", {}),
        ("envmap", "light.to_world", {}),
        ("sunsky", "light.sun_direction", {}),
        ("sunsky", "light.turbidity", {}),
        ("projector", "light.to_world", {}),
        ("textured", "light.to_world", {}),
        ("point", "light.position", {"light_samples": 2}),
        ("area", "light.to_world", {}),
        ("point", "ball.to_world", {}),
        ("point", "sensor.to_world", {}),
        ("point", "plastic.bsdf.diffuse_reflectance.value", {}),
    ],
)
def test_parameters_that_derivatives_leave_out_are_refused(blobs, kind, key, options):
    floor = {"plastic": {"type": "rectangle", "bsdf": {"type": "plastic"}}} if "plastic" in key else None
    light = {"light": emitters.emitter(kind, CENTER.tolist(), RADIUS)}
    scene = scenes.scene(blobs, scenes.nrf(**options), light, size=4, spp=1, shapes=floor)
    attached(scene, key)
    with pytest.raises(MiNtfError, match=f"gradients by {key}: not supported; detach it"):
        scene.integrator().render(scene)


def derivative(scene, parameters, set_to, h: float):
    """Return derivatives of the picture's mean by the t of `set_to(t)`: forward at 0, and by differences of ± `h`."""
    t = mi.Float(0)
    dr.enable_grad(t)
    set_to(t)
    parameters.update()
    result = dr.mean(mi.render(scene, parameters, seed=4, seed_grad=3)[..., :3], axis=None)
    dr.forward(t)
    found = []
    for step in (h, -h):
        set_to(mi.Float(step))
        parameters.update()
        found.append(float(dr.mean(mi.render(scene, parameters, seed=3)[..., :3], axis=None).array[0]))
    return float(dr.grad(result).array[0]), (found[0] - found[1]) / (2 * h)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["spot", "directional"])
def test_turning_lights(blobs, kind):
    """A spot's cone turns with it, a sun's shadows with the sun."""
    light = emitters.emitter(kind, CENTER.tolist(), RADIUS)
    if kind == "directional":
        light["to_world"] = mi.ScalarTransform4f().look_at([2, 2, 2], [0, 0, 0], [0, 1, 0])
        del light["direction"]
    scene = scenes.scene(blobs, scenes.nrf(samples=256), {"light": light}, size=12, spp=16)
    parameters = mi.traverse(scene)
    original = mi.Transform4f(parameters["light.to_world"].matrix)

    def turn(t):
        # From 5° off, since what is aimed at the object hardly changes its picture as it turns.
        parameters["light.to_world"] = original @ mi.Transform4f().rotate(mi.Vector3f(1, 0.3, 0), 5 + t)

    found, wanted = derivative(scene, parameters, turn, 1.0)
    assert found == pytest.approx(wanted, rel=0.05)  # the march's steps show in the differences: 1 to 3 %


@pytest.mark.parametrize("depth", [2, 4])
def test_reflectance_of_diffuse_surfaces(blobs, depth):
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.4, -1.2, 0.3]).rotate([1, 0, 0], -90).scale(3),
        "bsdf": {"type": "diffuse", "reflectance": 0.5},
    }
    light = {"light": point(CENTER + 2 * RADIUS * TOWARDS, 9.0)}
    scene = scenes.scene(blobs, scenes.nrf(max_depth=depth), light, size=8, spp=64, shapes={"floor": floor})
    parameters = mi.traverse(scene)
    name = "floor.bsdf.reflectance.value"
    original = mi.Float(parameters[name])

    def brighten(t):
        parameters[name] = original + t

    found, wanted = derivative(scene, parameters, brighten, 0.05)
    assert found == pytest.approx(wanted, rel=0.01)


def test_dark_lights_have_gradients(blobs):
    """A lamp of no power is no row of the table, but what it would add is known."""
    two = {"a": point(CENTER + 2 * RADIUS * TOWARDS, 9.0), "b": point(CENTER + np.array([0, 5, 2]), 0.0)}
    scene = scenes.scene(blobs, scenes.nrf(), two, size=8, spp=4)
    parameters = mi.traverse(scene)

    def light(t):
        parameters["b.intensity.value"] = mi.Color3f(t)

    found, wanted = derivative(scene, parameters, light, 1.0)
    assert wanted > 0 and found == pytest.approx(wanted, rel=1e-3)
