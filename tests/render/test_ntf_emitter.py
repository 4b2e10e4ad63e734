"""The ``ntf`` emitter: what it dims, what it must not add, and that no field shadows twice."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest
from helpers.derivatives import backward, differences, forward

from mi_ntf.core.errors import MiNtfError, root
from mi_ntf.infer import tuning
from mi_ntf.infer.visibility import REGISTRY
from mi_ntf.render.plugins import emitter

SEEDS = 4


def field(path) -> dict:
    return {"type": "nrf", "filename": str(path)}


def ball(path) -> dict:
    center, radius = list(scenes.SIMILARITY.center), scenes.SIMILARITY.radius
    return {
        "ball": {
            "type": "sphere",
            "center": center,
            "radius": radius,
            "bsdf": {"type": "null"},
            "interior": field(path),
        }
    }


ROUGH = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": {"type": "rgb", "value": [0.9, 0.8, 0.6]}}
ABOVE = {
    "point": {"type": "point", "position": [0.4, 3.0, -1.0], "intensity": 60.0},
    "directional": {"type": "directional", "direction": [0, -1, 0.4], "irradiance": 3.0},
    "spot": {"type": "spot", "cutoff_angle": 40.0, "intensity": 60.0},
    "constant": {"type": "constant", "radiance": 0.7},
    "area": {"type": "area", "radiance": 6.0},
    "projector": {"type": "projector", "fov": 60.0, "scale": 30.0},
    "sunsky": {"type": "sunsky", "sun_direction": [0, 0.9, -0.35], "sun_scale": 0.1},
}


def light(kind: str, path=None, visibility="raymarch") -> dict:
    """Light `kind` above and behind the object, through the field `path` if there is one."""
    emitter = dict(scenes.light("env") if kind == "envmap" else ABOVE[kind])
    look = mi.ScalarTransform4f().look_at([0.4, 3.0, -1.0], [0.4, -3.5, 1.5], [0, 0, 1])
    if kind in ("spot", "projector"):
        emitter["to_world"] = look
    if kind == "sunsky":
        emitter["to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    if path is not None:
        emitter = {"type": "ntf", "visibility": visibility, "medium": field(path), "emitter": emitter}
    if kind == "area":
        return {"lamp": {"type": "rectangle", "to_world": look @ mi.ScalarTransform4f().scale(1.5), "emitter": emitter}}
    return {"light": emitter}


@pytest.mark.parametrize(
    ("kind", "bsdf"),
    [
        ("constant", ROUGH),
        ("area", ROUGH),
        ("point", {"type": "diffuse"}),
        *(
            pytest.param(kind, {"type": "diffuse"}, marks=pytest.mark.slow)
            for kind in ("spot", "directional", "projector", "envmap", "sunsky")
        ),
    ],
)
def test_a_floor_in_the_shadow_equals_a_path_traced_field(blobs, kind, bsdf):
    """Rough metal reflects the light that BSDF samples reach, too: stock `path` with the ``ntf`` light against stock
    `volpath` with the field as a medium, whose own scattering lies a bounce beyond `max_depth`."""
    ours = scenes.floor({"type": "path", "max_depth": 2}, light(kind, blobs), bsdf)
    theirs = scenes.floor({"type": "volpath", "max_depth": 2}, light(kind), bsdf, **ball(blobs))
    open_ = scenes.floor({"type": "path", "max_depth": 2}, light(kind), bsdf)
    images = [
        [scenes.render(s, seed, spp)[..., :3] for seed in range(SEEDS)]
        for s, spp in ((ours, 256), (theirs, 512), (open_, 128))
    ]
    ztest.check(images[0], images[1], f"ntf volpath {kind}", block=2)
    difference = ztest.block_difference(np.mean(images[0], 0), np.mean(images[1], 0), 8, floor=0.3)
    assert difference.max() < 0.03  # measured 0.016
    # The shadow is there to be compared.
    with pytest.raises(AssertionError, match="values pass"):
        ztest.check(images[2], images[1], "without ntf", block=2)


@pytest.mark.parametrize(
    ("kind", "visibility", "tolerance"),
    # Of a map's one logistic a ray, which shadows' soft edges do not follow, 9 % and 5 %; of the volume 0.4 %.
    [
        ("spot", "transmittance_map", 0.12),
        ("directional", "transmittance_map", 0.08),
        ("spot", "transmittance_volume", 0.01),
    ],
)
def test_maps_of_one_light(blobs, kind, visibility, tolerance):
    """The table of one row that a map or volume is made for: the shadow that the march casts."""
    march, mapped, bare = (
        scenes.render(scenes.floor({"type": "direct"}, light(kind, blobs, v), {"type": "diffuse"}, 24), 0, 16)[..., 0]
        for v in ("raymarch", visibility, "none")
    )
    size = np.sqrt((bare**2).mean())
    assert np.sqrt(((bare - march) ** 2).mean()) > 0.5 * size  # a shadow there is
    assert np.sqrt(((mapped - march) ** 2).mean()) < tolerance * size


def test_the_shadow_of_a_sun_is_sharp_where_skies_are_looked_up(blobs, monkeypatch):
    """An atlas of few directions, by the same samples as the march: 0.5 % off, without the march to the sun 6 %."""
    monkeypatch.setitem(ABOVE, "sunsky", {**ABOVE["sunsky"], "sun_scale": 1.0})
    monkeypatch.setattr(tuning, "ATLAS_SIDE", 16)
    monkeypatch.setattr(tuning, "ATLAS_RESOLUTION", 32)

    def picture(visibility):
        loaded = scenes.floor({"type": "direct"}, light("sunsky", blobs, visibility), {"type": "diffuse"}, 24)
        return scenes.render(loaded, 0, 64)[..., :3]

    march = picture("raymarch")
    error = [np.sqrt(((picture("transmittance_atlas") - march) ** 2).mean() / (march**2).mean())]
    monkeypatch.setattr(emitter, "SHARP", np.inf)
    error += [np.sqrt(((picture("transmittance_atlas") - march) ** 2).mean() / (march**2).mean())]
    print("error of the floor with and without the march to the sun:", error)
    assert error[0] < 0.01 and error[1] > 0.03


@pytest.mark.parametrize("kind", ["directional", "constant"])
def test_shapes_far_off_hide_lights_from_afar(blobs, kind):
    """A ceiling 100 radii above the field, of which a nested light knows nothing: the floor below it is dark, but for
    what comes to it from less than 2° above the horizon, 0.06 % of a sky's light."""
    up = mi.ScalarTransform4f().translate([0, 150, 0]).rotate([1, 0, 0], 90).scale(1e5)
    ceiling = {"ceiling": {"type": "rectangle", "to_world": up}}

    def mean(path, **shapes):
        loaded = scenes.floor({"type": "direct"}, light(kind, path), {"type": "diffuse"}, 8, **shapes)
        return scenes.render(loaded)[..., :3].mean()

    assert mean(blobs, **ceiling) < 0.002 * mean(blobs)


@pytest.fixture
def few_directions(monkeypatch):
    monkeypatch.setattr(tuning, "ATLAS_SIDE", 8)
    monkeypatch.setattr(tuning, "ATLAS_RESOLUTION", 16)


@pytest.mark.parametrize("kind", ["sunsky", "constant", "area"])
def test_a_direction_is_worth_what_it_was_drawn_with(blobs, few_directions, monkeypatch, kind):
    """What integrators with derivatives ask for once more, by the same march or lookup."""
    monkeypatch.setitem(ABOVE, "sunsky", {**ABOVE["sunsky"], "sun_scale": 1.0})
    n, u = 1024, np.random.default_rng(0).random((4, 1024)).astype(np.float32)
    it = dr.zeros(mi.Interaction3f, n)
    it.p = mi.Point3f(mi.Float(4 * u[0] - 2), -2, mi.Float(4 * u[1] - 2))
    found = []
    for lights in (light(kind, blobs, "transmittance_atlas"), light(kind)):
        loaded = mi.load_dict({"type": "scene", **lights})
        ds, drawn = loaded.sample_emitter_direction(it, mi.Point2f(u[2], u[3]), False, True)
        again = loaded.emitters()[0].eval_direction(it, ds, ds.pdf > 0)
        found.append([np.broadcast_to(np.array(v)[:1], (1, n)) for v in (drawn, again)])
    # Beside the bare light: Mitsuba takes a few that it drew at the rim of a sun's disc for sky.
    bare = np.array(found[1])
    tau = np.where(bare > 0, np.array(found[0]) / np.where(bare > 0, bare, 1), 0)[:, (bare > 0).all(0)]
    assert tau.size > n and 0.01 < tau.mean() < 0.99
    np.testing.assert_allclose(tau[1], tau[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("kind", "visibility", "text"), [
    ("constant", "transmittance_map", "made for one light, but constant shines from many places"),
    ("point", "raymatch", "expected one of raymarch"),
])  # fmt: skip
def test_bad_input(blobs, kind, visibility, text):
    with pytest.raises((MiNtfError, RuntimeError), match=text) as caught:
        mi.load_dict(light(kind, blobs, visibility)["light"])
    assert "ntf emitter" in str(caught.value)


def test_the_camera_sees_what_is_wrapped(blobs):
    """Environment and lamp in the picture are the bare ones, but for light that they throw on the floor."""
    for kind in ("constant", "area"):
        bare, wrapped = (
            scenes.floor({"type": "path", "max_depth": 1}, light(kind, path), {"type": "diffuse"}, 8)
            for path in (None, blobs)
        )
        for scene in (bare, wrapped):
            up = mi.traverse(scene)
            up["sensor.to_world"] = mi.Transform4f().look_at([0.4, -2, 1], [0.4, 3, -1], [0, 0, 1])
            up.update()
        image = scenes.render(wrapped)
        assert image[..., :3].max() > 0.5
        np.testing.assert_allclose(image, scenes.render(bare), rtol=1e-5)


def test_parameters_reach_the_nested_light(blobs, monkeypatch):
    """What is changed in the wrapped light changes the picture. An update makes its map once."""
    loaded = scenes.floor({"type": "direct"}, light("point", blobs, "transmittance_map"), {"type": "diffuse"}, 8)
    parameters = mi.traverse(loaded)
    parameters["light.emitter.position"] = mi.Point3f(2.4, 3.0, -1.0)
    build, built = emitter.building.build, []
    monkeypatch.setattr(emitter.building, "build", lambda name, *rest: built.append(name) or build(name, *rest))
    parameters.update()
    assert built.count("transmittance_map") == 1
    moved = light("point", blobs, "transmittance_map")
    moved["light"]["emitter"]["position"] = [2.4, 3.0, -1.0]
    fresh = scenes.floor({"type": "direct"}, moved, {"type": "diffuse"}, 8)
    np.testing.assert_allclose(scenes.render(loaded, 1), scenes.render(fresh, 1), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("kind", "options"), [("point", {}), ("area", {}), ("constant", {"light_samples": 1})])
def test_a_field_does_not_shadow_itself_twice(blobs, kind, options):
    """`nrf` casts the shadow of its media: with an ``ntf`` light through the very field, the picture of the bare light.
    Another medium's shadow stays."""
    integrator = {"type": "nrf", "visibility": "raymarch", "hide_emitters": True, **options}
    bare, wrapped = (
        scenes.render(scenes.scene(blobs, integrator, light(kind, path), size=12, spp=4), 3) for path in (None, blobs)
    )
    # Equal seeds draw equal lights; sums are added in any order.
    np.testing.assert_allclose(wrapped, bare, rtol=1e-4, atol=1e-5)
    elsewhere = light(kind, blobs)
    emitter = elsewhere["lamp"]["emitter"] if kind == "area" else elsewhere["light"]
    emitter["medium"]["to_world"] = mi.ScalarTransform4f().translate([0, 0.4, -0.3])
    other = scenes.render(scenes.scene(blobs, integrator, elsewhere, size=12, spp=4), 3)
    assert other[..., :3].mean() < 0.9 * bare[..., :3].mean()


def test_a_floor_beside_its_field_is_not_shadowed_twice(blobs):
    """`nrf` on an ordinary surface: the ``ntf`` light through the scene's own field, and the bare one."""
    integrator = {"type": "nrf", "visibility": "raymarch", "hide_emitters": True}
    bare, wrapped = (
        scenes.render(scenes.floor(integrator, light("point", path), {"type": "diffuse"}, 8, **ball(blobs)), 3)
        for path in (None, blobs)
    )
    np.testing.assert_allclose(wrapped, bare, rtol=1e-3, atol=1e-4)  # equal seeds draw equal lights


def under(integrator: str, path, visibility: str):
    """The floor in the shadow of a point light, and its parameters."""
    options = {} if integrator == "direct" else {"max_depth": 2}
    loaded = scenes.floor({"type": integrator, **options}, light("point", path, visibility), {"type": "diffuse"}, 12)
    return loaded, mi.traverse(loaded)


@pytest.fixture(scope="module")
def soft(tmp_path_factory):
    """Shadows that move by more than a march's steps before they are gone."""
    return scenes.write_blobs(tmp_path_factory.mktemp("soft"), log_density=2.0, visibility=True)


def test_derivatives_by_a_lights_place(soft, few_directions):
    """Shadows move with the light; whatever else holds them, they are the march's."""
    place = "light.emitter.position", [1.0, 0.3, 0.5], mi.Point3f
    truth, unshadowed = (differences(*under("direct", soft, v), *place, 0.05) for v in ("raymarch", "none"))
    assert abs(truth - unshadowed) > 0.5 * abs(truth)
    for visibility in REGISTRY:
        slope = backward(*under("direct", soft, visibility), *place)
        assert slope == pytest.approx(unshadowed if visibility == "none" else truth, rel=0.04), visibility  # 0.015


@pytest.mark.parametrize(("integrator", "mode"), [("direct", forward), ("path", forward), ("prb", backward)])
@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_atlas"])
def test_derivatives_by_power_and_by_surfaces(soft, few_directions, integrator, mode, visibility):
    """The picture is linear in the one; with the other, the points that rays to the light start from move."""
    setting = under(integrator, soft, visibility)
    power = "light.emitter.intensity.value", [1.0, 0.5, 0.2], mi.Color3f
    assert mode(*setting, *power) == pytest.approx(differences(*setting, *power, 10.0), rel=1e-3)
    place = "floor.to_world", [0.0, 1.0, 0.0], mi.Transform4f
    truth = differences(*under("direct", soft, "raymarch"), *place, 0.05)
    assert mode(*setting, *place) == pytest.approx(truth, rel=0.12)  # 0.08; without the shadow's, of the other sign


def test_prb_knows_no_derivative_by_a_lights_place(soft):
    """Beside one that it knows it would leave that out without a word."""
    loaded, parameters = under("prb", soft, "raymarch")
    for key, kind in (("light.emitter.position", mi.Point3f), ("light.emitter.intensity.value", mi.Color3f)):
        value = kind(parameters[key])
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    with pytest.raises((MiNtfError, RuntimeError)) as caught:
        dr.backward(dr.mean(mi.render(loaded, parameters, spp=1), axis=None))
    assert "ntf emitter: gradients by position of its light: prb leaves them out" in str(root(caught.value))


@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_atlas", "transmittance_map"])
def test_shadows_follow_a_density_that_was_set(blobs, visibility):
    """Two lights share a medium by name, of which Mitsuba tells one alone that it has changed."""
    medium = f'<medium type="nrf" id="field"><string name="filename" value="{blobs}"/></medium>'
    method = f'<string name="visibility" value="{visibility}"/>'
    lights = "".join(f'<emitter type="ntf">{method}<emitter type="point"><point name="position" value="{x}, 3, -1"/>'
                     '</emitter><ref id="field"/></emitter>' for x in (0, 1))
    inner = mi.load_string(f'<scene version="3.0.0">{medium}{lights}</scene>')
    assert follows(inner, "field.log_density", -20.0, mi.Point3f(0.3, -3.4, 1.6))


def test_shadows_follow_a_stock_medium_that_was_set():
    body = ('<shape type="sphere" id="body"><bsdf type="null"/><medium type="homogeneous" name="interior">'
            '<float name="sigma_t" value="4"/></medium></shape>')
    light = '<emitter type="ntf"><emitter type="point"><point name="position" value="{}, 4, 0"/></emitter>{}</emitter>'
    inner = mi.load_string('<scene version="3.0.0">' + light.format(0, body) + light.format(1, '<ref id="body"/>')
                           + "</scene>")
    key = next(key for key in mi.traverse(inner).keys() if "sigma_t" in key)
    assert follows(inner, key, 0.0, mi.Point3f(0, -4, 0))


def follows(scene, key: str, value: float, point) -> bool:
    """Return True if each light of a scene is dimmed at a point, and no more once parameter `key` is `value`."""
    parameters = mi.traverse(scene)
    it = dr.zeros(mi.SurfaceInteraction3f)
    it.p = point

    def brightness():
        return [float(light.sample_direction(it, mi.Point2f(0.5))[1].x[0]) for light in scene.emitters()]

    before = brightness()
    parameters[key] = 0 * parameters[key] + value
    parameters.update()
    return all(b < 0.5 * a for b, a in zip(before, brightness(), strict=True))
