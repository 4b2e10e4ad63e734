"""Media of very unequal size, lamps behind walls, many runs of lights and bounces, against exact answers."""


import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes
from helpers.scenes import nrf

from mi_ntf.core import field_file
from mi_ntf.core.architecture import Similarity
from mi_ntf.render.transport import passes

WHITE = {"albedo": (1 - 1e-6,) * 3, "specular": 1e-6}


def save(folder, name, header, tensors):
    path = folder / f"{name}.safetensors"
    field_file.save(path, header, tensors, np.float32)
    return path


def view(shapes: dict, lights: dict, options: dict, size=16, spp=64, width=1.0, centre=(0, 0, 0)):
    """Return an orthographic view along −z of a square around `centre`, `width` to each side."""
    look = mi.ScalarTransform4f().look_at([*centre[:2], 400], list(centre), [0, 1, 0]).scale(width)
    sensor = {"type": "orthographic", "to_world": look, "far_clip": 1e5, "film": scenes.film(size),
              "sampler": {"type": "multijitter", "sample_count": spp}}  # fmt: skip
    return scenes.render(mi.load_dict({"type": "scene", "integrator": nrf(**options), "sensor": sensor, **shapes,
                                       **lights}))  # fmt: skip


HEAD_ON = {"light": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 3.0}}}


@pytest.mark.parametrize("order", ["fog first", "ball first"])
def test_fog_beside_a_small_field_in_both_orders(tmp_path, order):
    """A fog of radius 100 and optical depth 1 looks as it does alone, in either order of the shapes."""
    fog_place, ball_place = Similarity((0.0, 0.0, 0.0), 100.0), Similarity((0.0, 120.0, 0.0), 1.0)
    fog = save(tmp_path, "fog", *fields.uniform(0.5, similarity=fog_place))
    ball = save(tmp_path, "ball", *fields.blobs([(0, 0, 0)], [0.5], similarity=ball_place))
    shapes = {"fog": scenes.ball(fog, fog_place, resolution=64), "ball": scenes.ball(ball, ball_place, resolution=64)}
    pair = shapes if order == "fog first" else dict(reversed(shapes.items()))
    alone, both = (view(s, HEAD_ON, {}, width=60.0, size=8, spp=16) for s in ({"fog": shapes["fog"]}, pair))
    assert alone[..., :3].mean() > 0.05
    # The same lattice of cells by the same samples; distances are rounded in another unit.
    np.testing.assert_allclose(both, alone, rtol=2e-3, atol=1e-4)


def test_a_small_field_inside_a_large_fog(tmp_path):
    """Lit and seen along the axis, fog before and beside the ball has a closed form."""
    fog_place, ball_place = Similarity((0.0, 0.0, 0.0), 100.0), Similarity((0.0, 0.0, 20.0), 1.0)
    fog = save(tmp_path, "fog", *fields.uniform(0.2, similarity=fog_place, specular=1e-6))
    ball = save(tmp_path, "ball", *fields.blobs([(0, 0, 0)], [0.5], log_density=6, edge=30, similarity=ball_place))
    shapes = {"fog": scenes.ball(fog, fog_place, resolution=64), "ball": scenes.ball(ball, ball_place)}
    pair = shapes, {"ball": shapes["ball"]}
    both, alone = (view(s, HEAD_ON, {}, spp=1024, centre=(0, 0, 20)) for s in pair)
    full = 3 * np.array((0.6, 0.5, 0.4)) * 2 / np.pi  # E f of the diffuse lobe
    # Normals point away from the fog's middle, so its far half reflects nothing to here.
    beside, before = (full * (1 - np.exp(-2 * 0.2 * length)) / 2 for length in (1.0, 0.795))
    np.testing.assert_allclose(both[0, 0, :3], beside, rtol=0.03)  # voxels of 1/64 at the rim
    assert both[0, 0, 3] == pytest.approx(1 - np.exp(-0.4), abs=0.01)
    brightness = both[7:9, 7:9, :3].mean((0, 1)) - np.exp(-0.4 * 0.795) * alone[7:9, 7:9, :3].mean((0, 1))
    np.testing.assert_allclose(brightness, before, rtol=0.04)


@pytest.mark.parametrize("count", [1, 5])
def test_transmittance_of_uniform_balls_of_sizes_1_to_1000(tmp_path, count):
    """Optical depths of chords add where small balls lie inside one a thousand times larger; five are one medium."""
    path = save(tmp_path, "ball", *fields.uniform(0.5, similarity=Similarity((0.0, 0.0, 0.0), 1.0)))
    move = mi.ScalarTransform4f().translate
    places = {"large": move([0, 0, 0]).scale(100)}
    places |= {f"small_{i}": move([0, 0, 20 - 0.05 * i]).scale(0.1) for i in range(count)}
    shapes = {name: scenes.ball(path, Similarity(), resolution=96, to_world=to_world) | {"to_world": to_world}
              for name, to_world in places.items()}
    alpha = view(shapes, HEAD_ON, {}, size=16, spp=256, width=0.15, centre=(0, 0, 20))[..., 3]
    c = (np.arange(128) + 0.5) / 128 * 0.3 - 0.15
    chord = np.sqrt(np.maximum(0.01 - c**2 - c[:, None] ** 2, 0))
    expected = 1 - np.exp(-1.0 - count * chord * 10).reshape(16, 8, 16, 8).mean((1, 3))
    np.testing.assert_allclose(alpha, expected, atol=0.03)  # voxels of 1/48 at the rims
    assert abs((alpha - expected).mean()) < 0.004


@pytest.mark.parametrize(
    "options",
    [
        {"visibility": "raymarch"},
        {"visibility": "transmittance_map"},
        {"visibility": "transmittance_map", "map_components": 2},
        {"visibility": "transmittance_volume"},
    ],
    ids=str,
)
def test_a_lamp_in_opaque_matter_stays_dark(tmp_path, options):
    """No light passes the optical depth of 60 between a strong lamp and all visible points."""
    path = save(tmp_path, "ball", *fields.blobs([(0, 0, 0)], [0.8], log_density=5.0))
    lamp = {"lamp": {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1e6}}
    image = view({"ball": scenes.ball(path, Similarity())}, lamp, options, spp=4)
    bare = view({"ball": scenes.ball(path, Similarity())}, lamp, {"visibility": "none"}, spp=4)
    assert image[..., 3].mean() > 0.3 and image[..., :3].max() < 1e-6
    assert bare.shape == image.shape


def test_matter_in_the_shadow_of_a_far_surface(tmp_path):
    """A wall 2·10⁴ radii behind the object stops shadow rays, and its lit part has the right radiance."""
    path = save(tmp_path, "ball", *fields.blobs([(0, 0, 0)], [0.8], log_density=5.0))
    far = {"far": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2e4]).scale(1e3)},
           "ball": scenes.ball(path, Similarity())}  # fmt: skip
    image = view(far, HEAD_ON, {"max_depth": 2}, width=4.0)
    edge = image[0, :, :3]  # beside the ball: Lambert of albedo 0.5
    np.testing.assert_allclose(edge, 0.5 * 3 / np.pi, rtol=1e-3)


def furnace(path, depth, **options):
    light = {"light": {"type": "constant", "radiance": 1.0}}
    options = {"visibility": "raymarch", "max_depth": depth, "environment_lights": 256, "samples": 1024, **options}
    return view({"ball": scenes.ball(path, Similarity(), resolution=256)}, light, options, size=4, spp=64, width=0.5)


def test_further_bounces_add_nothing_to_a_convex_object(tmp_path):
    """A convex skin looks the same at every depth, in a white furnace as well."""
    path = save(tmp_path, "white", *fields.blobs([(0, 0, 0)], [0.8], log_density=6.4, edge=60, **WHITE))
    images = {depth: furnace(path, depth)[..., :3].mean() for depth in (2, 3, -1)}
    assert images[3] == pytest.approx(images[2], rel=0.01)
    assert images[-1] == pytest.approx(images[2], rel=0.01)
    # Drawn paths: 1024 of them, of which hardly any finds matter again.
    assert furnace(path, -1, bounces="paths")[..., :3].mean() == pytest.approx(images[2], rel=0.01)
    # A skin of finite thickness on a curved object lets in grazing light that a flat one would keep out: 2 % here.
    assert 0.97 < images[2] < 1.03


def test_a_stopped_render_shows_whole_light_or_none(blobs, monkeypatch):
    """Stopped in the last of three runs, pixels are those of the whole picture or empty."""
    monkeypatch.setattr("mi_ntf.render.transport.rendering.CHUNK", 256)
    lights = {f"light_{i}": {"type": "point", "position": [3.4 - 2 * i, 3.0, 2.5], "intensity": 50.0} for i in range(3)}
    options = {"visibility": "transmittance_map", "map_resolution": 32, "map_memory": 32**2 * 8 / 2**20}
    loaded = scenes.scene(blobs, nrf(**options, timeout=1e9), lights, size=16, spp=16)
    whole = scenes.render(loaded)
    ticks, runs = iter(range(10**6)), 3 * 16  # chunks of a row of pixels in each run
    stop = runs - 6
    monkeypatch.setattr(passes.Passes, "overtime", lambda self, timeout: next(ticks) > stop)
    part = scenes.render(loaded)
    rows = (part != 0).any((1, 2))
    assert rows.any() and not rows[-4:].any()
    np.testing.assert_array_equal(part[rows], whole[rows])


def test_derivatives_ask_for_the_memory_of_all_maps(blobs):
    lights = {f"light_{i}": {"type": "point", "position": [3.4 - 2 * i, 3.0, 2.5], "intensity": 50.0} for i in range(3)}
    options = {"visibility": "transmittance_map", "map_resolution": 32, "map_memory": 32**2 * 8 / 2**20}
    loaded = scenes.scene(blobs, nrf(**options), lights, size=8, spp=2)
    parameters = mi.traverse(loaded)
    dr.enable_grad(parameters["light_0.intensity.value"])
    parameters.update()
    with pytest.raises(Exception) as caught:
        dr.backward(mi.render(loaded, parameters))
    error, texts = caught.value, []
    while error is not None:
        texts.append(str(error))
        error = error.__cause__
    assert "derivatives need the maps of all 3 lights" in " ".join(texts)
