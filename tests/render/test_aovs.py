"""Further outputs of an analytic ball, and of a ball before a wall."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes

from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.transport import aovs

RADIUS, SIZE = 0.8, 16
ALBEDO = (0.6, 0.5, 0.4)
EVERY = "depth,normal,albedo,roughness,opacity,visibility,visibility_lights"


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Return an opaque ball of radius 0.8 around the origin, with a skin of 0.01 and normals outwards."""
    path = tmp_path_factory.mktemp("field") / "ball.safetensors"
    header, tensors = fields.blobs([(0, 0, 0)], [RADIUS], log_density=6.4, edge=60, albedo=ALBEDO, specular=1e-6)
    field_file.save(path, header, tensors, np.float32)
    return path


LIGHTS = {
    "ahead": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0},
    "aside": {"type": "directional", "direction": [-1, 0, 0], "irradiance": 1.0},
}


def layers(field, names: str, lights=LIGHTS, spp=16, film="rgba", shapes=None, **options):
    """Return name → (h, w) of the extra channels and of R, G, B, seen along −z over [−1, 1]² from z = 3."""
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "nrf", "visibility": "raymarch", "samples": 768, "aovs": names, "hide_emitters": True,
                       **options},
        "sensor": {
            "type": "orthographic",
            "near_clip": 1.0,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": scenes.film(SIZE) | {"pixel_format": film},
            "sampler": {"type": "independent", "sample_count": spp},
        },
        "ball": {"type": "sphere", "bsdf": {"type": "null"},
                 "interior": {"type": "nrf", "filename": str(field), "resolution": 256}},
        **(shapes or {}),
        **lights,
    })  # fmt: skip
    mi.render(scene)
    image = scene.sensors()[0].film().bitmap()
    outputs = [f.name for f in image.struct_()]
    return dict(zip(outputs, np.moveaxis(np.array(image), -1, 0), strict=True)), scene.integrator()


def pixels():
    """Return the middles of the pixels, and the distance from the axis in radii."""
    c = (np.arange(SIZE) + 0.5) * 2 / SIZE - 1
    x, y = np.meshgrid(c, -c)
    return x, y, np.hypot(x, y) / RADIUS


def test_ball(ball):
    outputs, integrator = layers(ball, EVERY)
    x, y, rho = pixels()
    inner, outer = rho < 0.85, rho > 1.15
    z = np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0))
    # A pixel is 0.125 wide. At ρ = 0.85 depth falls by 0.2 within it, and curves by 0.02; the mean of 16 rays strays by
    # 0.015. The skin is 0.01 thick.
    np.testing.assert_allclose(outputs["depth.T"][inner], (3 - z)[inner], atol=0.06)
    normal = np.stack([outputs[f"normal.{c}"] for c in "XYZ"], -1)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1)[inner], 1, rtol=1e-4)
    np.testing.assert_allclose(normal[inner], np.stack([x, y, z], -1)[inner] / RADIUS, atol=0.06)
    for channel, value in zip("RGB", ALBEDO, strict=True):
        np.testing.assert_allclose(outputs[f"albedo.{channel}"][inner], value, rtol=0.01)
    np.testing.assert_allclose(outputs["roughness.Y"][inner], 0.5, rtol=0.01)
    np.testing.assert_allclose(outputs["opacity.Y"][inner], 1, atol=1e-3)
    np.testing.assert_allclose(outputs["opacity.Y"], outputs["A"], atol=1e-6)
    for name in integrator.aov_names():
        assert (outputs[name][outer] == 0).all(), name


def test_visibility_of_the_ball(ball):
    """From the camera's side, light arrives as the view does.

    E[τ] = E[T] under the weights = 1/2 for an opaque skin. Light from +x is as strong there, and 0 on the far side.
    """
    outputs, integrator = layers(ball, EVERY, spp=64)
    x, _, rho = pixels()
    ahead, aside = outputs["visibility_lights.0.Y"], outputs["visibility_lights.1.Y"]
    np.testing.assert_allclose(outputs["visibility.Y"], (ahead + aside) / 2, atol=1e-5)
    np.testing.assert_allclose(ahead[rho < 0.7], 0.5, atol=0.03)  # 64 samples a pixel of spread 0.3, a march to 1 %
    assert (aside[(rho < 0.7) & (x < -0.2)] < 0.01).all()
    assert integrator.aov_names()[-2:] == ["visibility_lights.0.Y", "visibility_lights.1.Y"]


def test_lights_in_runs(ball):
    """Maps in several runs add up to the result of all maps together."""
    options = {"visibility": "transmittance_map", "map_resolution": 64, "spp": 4}
    whole, _ = layers(ball, EVERY, **options)
    parts, _ = layers(ball, EVERY, map_memory=64**2 * 8 / 2**20, **options)
    for name, values in whole.items():
        np.testing.assert_allclose(parts[name], values, atol=2e-5, err_msg=name)


def test_visibility_is_known_at_the_camera_and_1_without_shadows(ball):
    none, _ = layers(ball, "visibility", visibility="none")
    inner = pixels()[2] < 0.85
    np.testing.assert_allclose(none["visibility.Y"][inner], 1, rtol=1e-5)


def test_soft_matter(tmp_path):
    """σ = 0.7 in the unit sphere: depth and opacity of exponential free flight."""
    path = tmp_path / "soft.safetensors"
    field_file.save(path, *fields.uniform(0.7), np.float32)
    outputs, _ = layers(path, "depth,opacity", lights={}, spp=64)
    x, y, _ = pixels()
    r = np.hypot(x, y)
    inner = r < 0.8
    h = np.sqrt(1 - r[inner] ** 2)
    opacity = 1 - np.exp(-1.4 * h)
    mean = 3 - h + 1 / 0.7 - 2 * h * np.exp(-1.4 * h) / opacity
    np.testing.assert_allclose(outputs["opacity.Y"][inner], opacity, atol=0.01)  # h varies within a pixel
    np.testing.assert_allclose(outputs["depth.T"][inner], mean, atol=0.01)


def test_wall_behind_the_ball(ball):
    wall = {"wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3),
                     "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}}}
    outputs, _ = layers(ball, "depth,normal,albedo,opacity,roughness", shapes=wall)
    _, _, rho = pixels()
    outer = rho > 1.15
    np.testing.assert_allclose(outputs["depth.T"][outer], 5, rtol=1e-5)
    np.testing.assert_allclose(outputs["normal.Z"][outer], 1, rtol=1e-5)
    np.testing.assert_allclose(outputs["albedo.B"][outer], 0.3, rtol=1e-5)
    assert (outputs["opacity.Y"] > 0.999).all() and (outputs["roughness.Y"][outer] == 0).all()
    np.testing.assert_allclose(outputs["albedo.B"][rho < 0.85], ALBEDO[2], rtol=0.01)


def test_light_is_the_same_with_and_without(ball):
    with_them, _ = layers(ball, EVERY)
    without, _ = layers(ball, "")
    assert list(without) == ["R", "G", "B", "A"]
    for channel in "RGBA":
        np.testing.assert_allclose(with_them[channel], without[channel], atol=1e-6)


def test_unlit_scenes_have_outputs_too(ball):
    outputs, _ = layers(ball, "depth,albedo", lights={}, film="rgb")
    inner = pixels()[2] < 0.85
    assert (outputs["R"] == 0).all()
    np.testing.assert_allclose(outputs["albedo.R"][inner], ALBEDO[0], rtol=0.01)


def test_what_is_not_asked_for_is_not_traced(ball, monkeypatch):
    def refuse(*args):
        raise AssertionError("traced")

    monkeypatch.setattr(aovs.Sums, "_visibility", refuse)
    monkeypatch.setattr(aovs.Sums, "add_surface", refuse)
    outputs, _ = layers(ball, "depth,albedo")
    assert outputs["depth.T"].max() > 0
    with pytest.raises(Exception, match="custom") as asked:
        layers(ball, "visibility")
    assert "traced" in str(asked.value.__cause__)
    monkeypatch.setattr(aovs.Sums, "add_field", refuse)
    monkeypatch.setattr(aovs, "Picture", refuse)
    outputs, _ = layers(ball, "")
    assert list(outputs) == ["R", "G", "B", "A"] and outputs["R"].max() > 0


@pytest.mark.parametrize(("text", "error"), [
    ("dept", 'aovs has "dept", expected some of depth, normal'),
    ("depth, normal,depth", 'aovs has "depth" twice'),
])  # fmt: skip
def test_bad_names(text, error):
    with pytest.raises(MiNtfError, match=error):
        aovs.parse(text)


def test_names_and_lights():
    assert aovs.parse(" depth, albedo,") == ("depth", "albedo")
    assert aovs.channel_names(("normal", "visibility_lights"), 2) == [
        "normal.X", "normal.Y", "normal.Z", "visibility_lights.0.Y", "visibility_lights.1.Y"]
    with pytest.raises(MiNtfError, match="needs 1 to 128 lights that are points or directions, this scene has 512"):
        aovs.channel_names(("visibility_lights",), 512)
    with pytest.raises(MiNtfError, match="this scene has none"):
        aovs.channel_names(("visibility",), 0)


@pytest.mark.parametrize("output", ["visibility", "visibility_lights"])
def test_no_visibility_where_no_light_is_scattered(ball, output):
    with pytest.raises(MiNtfError, match="max_depth is 1, at which fields scatter no light"):
        layers(ball, output, max_depth=1)
