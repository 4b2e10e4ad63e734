"""Multiple scattering without noise, against stock ``path`` on meshes of the same shape and traced paths."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, pictures

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.transport import bounced

PLACES = (-0.65, 0.65)
RADIUS = 0.5 + 0.01 * np.log(np.exp(5) * 0.01 / np.log(2))
"""Where the skin has stopped half of the light."""
ALBEDO = (0.8, 0.5, 0.2)
SUN = pictures.sun((0.36, 0.48, 0.8))


@pytest.fixture(scope="module")
def skin(tmp_path_factory):
    """Return a diffuse sphere of radius ½ with a skin two voxels wide."""
    field = fields.skin("sphere", log_density=5.0, scale=0.01, albedo=ALBEDO, specular=1e-5, roughness=0.9)
    return pictures.save(tmp_path_factory.mktemp("skin"), (field.header, field.tensors))


def look(spread: float = 0.0) -> dict:
    return pictures.camera((0, 0.8, 4.0 + spread), fov=32.0, size=24)


def pair(path) -> dict:
    """Return two of the spheres side by side, each a field."""
    return {f"ball{i}": {**pictures.ball(path, to_world=mi.ScalarTransform4f().translate([x, 0, 0])),
                         "center": [x, 0, 0]} for i, x in enumerate(PLACES)}  # fmt: skip


def added(method, things, depth=-1, spp=16, **options):
    """Return what further bounces add to the picture's mean, relative to single scattering."""
    means = [pictures.render(method, things, spp, max_depth=d, **options)[..., :3].mean((0, 1)) for d in (2, depth)]
    return means[1] / means[0] - 1


def added_to_mesh(light: dict, depth: int) -> np.ndarray:
    shapes = {f"ball{i}": {"type": "sphere", "center": [x, 0, 0], "radius": RADIUS,
                           "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(ALBEDO)}}}
              for i, x in enumerate(PLACES)}  # fmt: skip
    means = []
    for d in (2, depth):
        path = {"type": "path", "max_depth": d, "hide_emitters": True}
        scene = mi.load_dict({"type": "scene", "integrator": path, "sensor": look(), "light": light, **shapes})
        means.append(np.array(mi.render(scene, spp=512))[..., :3].mean((0, 1)))
    return means[1] / means[0] - 1


@pytest.mark.parametrize(("kind", "depth"), [("sun", 3), ("sky", -1), pytest.param("sun", -1, marks=pytest.mark.slow),
                                             pytest.param("sky", 3, marks=pytest.mark.slow)])  # fmt: skip
def test_two_spheres_light_each_other_as_surfaces_do(skin, kind, depth):
    light = {"sun": SUN, "sky": {"type": "constant"}}[kind]
    things = {"sensor": look(), "light": light, **pair(skin)}
    result = added("raymarch", things, depth, environment_lights=64, bounces="radiosity")
    mesh = added_to_mesh(light, depth)
    # Of what bounces add. Measured 6 to 9 %: the second voxel of a skin this wide is nearer to the other sphere still.
    np.testing.assert_allclose(result, mesh, rtol=0.1, atol=5e-4)


def test_a_convex_body_gets_nothing_and_pictures_have_no_more_noise(skin):
    things = {"sensor": pictures.camera((0, 0.8, 4.0), fov=20.0, size=24), "sun": SUN, "ball": pictures.ball(skin)}
    single, all_ = (pictures.render("raymarch", things, spp=4, max_depth=d, bounces="radiosity") for d in (2, -1))
    np.testing.assert_allclose(all_, single, atol=1e-3 * single.max())


@pytest.mark.slow
def test_light_at_the_camera_takes_its_short_way(skin):
    """A single march for view and light gives the same picture as a light beside the camera."""
    flash = {"type": "point", "intensity": 40.0}
    pictures_ = [
        pictures.render("raymarch", {"sensor": look(), "flash": {**flash, "position": [x, 0.8, 4.0]}, **pair(skin)},
                        max_depth=-1, bounces="radiosity")[..., :3].mean() for x in (0.0, 0.02)
    ]  # fmt: skip
    assert pictures_[0] == pytest.approx(pictures_[1], rel=5e-3)


def test_runs_of_lights_add_up(skin):
    """Bounced light counts once if maps are built in several runs."""
    things = {"sensor": look(), **{f"sun{k}": pictures.sun(d) for k, d in enumerate(np.eye(3))}, **pair(skin)}
    whole, parts = (pictures.render("transmittance_map", things, max_depth=-1, map_resolution=64, map_memory=m)
                    for m in (1024.0, 0.08))
    np.testing.assert_allclose(parts[..., :3].mean((0, 1)), whole[..., :3].mean((0, 1)), rtol=2e-3)


def test_what_radiosity_does_not_know_is_traced_or_refused(skin, tmp_path):
    floor = {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3])}}
    smoke = pictures.save(tmp_path, fields.uniform(0.5), "smoke")
    things = {"sensor": look(), "sun": SUN, "ball": pictures.ball(skin)}
    smoky = things | {"ball": pictures.ball(smoke, resolution=64)}
    for other, word in ((things | floor, "surfaces"), (smoky, "smoke")):
        scene = mi.load_dict({"type": "scene", "integrator": pictures.integrator("raymarch", max_depth=3,
                                                                                 bounces="radiosity"), **other})
        with pytest.raises(MiNtfError, match=f"bounces=radiosity.*{word}.*bounces=paths"):
            scene.integrator().render(scene, spp=1)
        paths, auto = (pictures.render("raymarch", other, spp=1, max_depth=3, bounces=b) for b in ("paths", "auto"))
        np.testing.assert_array_equal(auto, paths)


@pytest.mark.slow
def test_few_drawn_lights_bounce_like_many(skin):
    """Few sampled lights of the patches suffice, which are the same for all samples of a pixel."""
    places = [(3, 0, 0), (-3, 0, 0), (0, 3, 0), (0, -1.5, 0), (0, 0, 3), (0, 0, -3), (0, 0.8, 0), (0, 0, 1)]
    lights = {f"light{i}": {"type": "point", "position": list(p), "intensity": 5.0} for i, p in enumerate(places)}
    things = {"sensor": look(), **lights, **pair(skin)}
    few, many = (np.subtract(*(pictures.render("raymarch", things, 1, max_depth=d, light_samples=n, bounces="radiosity")
                               for d in (-1, 2)))[..., :3].mean(-1) for n in (1, 256))  # fmt: skip
    # 64 draws. 16 differ by 1.8 % of the mean, a single one by 6 %.
    assert few.mean() == pytest.approx(many.mean(), rel=0.01)
    bright = many > 0.3 * many.max()
    assert np.sqrt(((few - many)[bright] ** 2).mean()) < 0.03 * many[bright].mean()


def test_what_is_read_back_is_computed_once(variant):
    """A single kernel computes the three channels."""
    values = dr.arange(mi.Float, 1000) + 1
    dr.eval(values)
    light = mi.Color3f(dr.sqrt(values), dr.log(values), values * values)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        rows = bounced._rows(light)
        launched = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(launched) == 1
    x = np.arange(1, 1001)
    np.testing.assert_allclose(rows, np.stack([np.sqrt(x), np.log(x), x * x], 1), rtol=1e-6)


def test_a_field_that_no_line_meets(tmp_path):
    """A field of a thousandth of the sphere has no patches and renders without error."""
    field = fields.blobs([(0.2, 0, 0)], [0.004], log_density=6.5, edge=2)
    things = {"sensor": pictures.camera((0, 0, 3), fov=1.0), "sun": SUN,
              "ball": pictures.ball(pictures.save(tmp_path, field), resolution=64)}  # fmt: skip
    image = pictures.render("raymarch", things, max_depth=-1)
    assert np.isfinite(image).all()


def test_an_albedo_that_is_set_takes_part_in_bounces(skin, monkeypatch, tmp_path):
    """The patches of an earlier picture, in memory or in the user's cache, do not stand for those of another albedo."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    integrator = {"type": "nrf", "visibility": "raymarch", "max_depth": -1, "bounces": "radiosity", "samples": 96}

    def right_ball(scene):
        return np.array(mi.render(scene, spp=16))[:, 13:, :3].mean((0, 1))

    def darkened(scene):
        parameters = mi.traverse(scene)
        key = "ball0.interior_medium.albedo"
        parameters[key] = 0 * parameters[key]
        parameters.update()
        return right_ball(scene)

    things = {"type": "scene", "integrator": integrator, "sensor": look(), "light": SUN, **pair(skin)}
    monkeypatch.setenv("MI_NTF_CACHE", "off")
    expected = darkened(mi.load_dict(things))
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    scene = mi.load_dict(things)
    bright = right_ball(scene)
    assert bright[0] > 1.01 * expected[0]
    np.testing.assert_allclose(darkened(scene), expected, rtol=1e-3)
