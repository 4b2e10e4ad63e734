"""The ``nrf`` integrator against stock ``volpath``, analytic fields and meshes."""

import dataclasses
import gc
import time
import weakref

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes, ztest
from helpers.scenes import nrf

from mi_ntf.core import field_file
from mi_ntf.core.architecture import FAST, Encoding, Header
from mi_ntf.infer import backend
from mi_ntf.infer.network import NetworkField
from mi_ntf.render.scene import loaded
from mi_ntf.render.scene.media import find_media

SEEDS = 4


def renders(path, integrator, kind, spp, **options):
    loaded = scenes.scene(path, integrator, {"light": scenes.light(kind)}, spp=spp, **options)
    return [scenes.render(loaded, seed) for seed in range(SEEDS)]


@pytest.mark.slow  # test_lights.py compares every emitter, in larger blocks
@pytest.mark.parametrize("kind", ["directional", "point", "env"])
def test_agrees_with_volpath(blobs, kind):
    """Single scattering agrees with delta tracking: z-test per 4×4 block, 8×8 block means within 2 %."""
    # The environment in both as Mitsuba samples it: `light_samples` draws from the very map.
    extra = {"light_samples": 2} if kind == "env" else {}
    ours = renders(blobs, nrf(samples=1024, **extra), kind, 64, size=48, sampler="multijitter")
    theirs = renders(
        blobs, {"type": "volpath", "max_depth": 2, "hide_emitters": True}, kind, 144, size=48, sampler="multijitter"
    )
    ztest.check([i[..., :3] for i in ours], [i[..., :3] for i in theirs], f"nrf volpath {kind}", block=8)
    # volpath's own noise in a block of 64 pixels · 4 · 144 paths of relative spread 1: 0.5 %.
    difference = ztest.block_difference(np.mean(ours, 0)[..., :3], np.mean(theirs, 0)[..., :3], 8, floor=0.3)
    assert difference.max() < 0.02
    alpha = ztest.block_difference(np.mean(ours, 0)[..., 3:], np.mean(theirs, 0)[..., 3:], 8, floor=0.3)
    assert alpha.max() < 0.01


def test_environment_as_directional_lights(blobs):
    """The exhaustive sum equals Mitsuba's sampling, apart from the position of a light in its texel."""
    sampled = np.mean(renders(blobs, nrf(light_samples=8), "env", 16, size=32), 0)
    summed = scenes.render(
        scenes.scene(blobs, nrf(environment_lights=128), {"light": scenes.light("env")}, spp=16, size=32)
    )
    difference = ztest.block_difference(summed[..., :3], sampled[..., :3], 8, floor=0.3)
    assert difference.max() < 0.05  # texels of 22°: lights at their middle move penumbrae between blocks
    assert summed[..., :3].mean() == pytest.approx(sampled[..., :3].mean(), rel=0.01)


def test_map_and_network_field_agree_with_grid(blobs):
    """`transmittance_map` agrees with `raymarch`, and the networks with their baked grid."""
    lights = {"light": scenes.light("directional")}
    march = scenes.render(scenes.scene(blobs, nrf(), lights, spp=64))
    tmap = scenes.render(scenes.scene(blobs, nrf("transmittance_map"), lights, spp=64), seed=1)
    network = scenes.render(scenes.scene(blobs, nrf(), lights, spp=64, medium={"representation": "network"}), seed=2)

    def relative(a):
        return np.sqrt(((a - march)[..., :3] ** 2).mean() / (march[..., :3] ** 2).mean())

    # Skins of the blobs are a tenth of their radius thick: one logistic is off by some per cent there.
    assert relative(tmap) < 0.08
    # Two renders of 64 spp differ by some 2 % in noise; trilinear voxels of ln σ add little.
    assert relative(network) < 0.04


@pytest.mark.parametrize("options", [
    {"visibility": "transmittance_map", "map_memory": 0.0025}, {"visibility": "transmittance_atlas", "max_depth": 3},
    {"visibility": "auto", "max_error": 0.5}, {"visibility": "raymarch", "aovs": "depth,visibility"}])
def test_a_scene_is_freed_when_nothing_refers_to_it(blobs, options):
    """Maps take memory until then, and the number of living plugins is part of the code of kernels."""
    floor = {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0.4, -3.5, 0.3])
                       .rotate([1, 0, 0], -90).scale(12)}}
    lights = {kind: scenes.light(kind) for kind in ("directional", "point")}
    gc.collect()
    gc.disable()
    try:
        scene = scenes.scene(blobs, nrf(map_resolution=16, environment_lights=4, **options), lights, shapes=floor,
                             size=8, spp=1, medium={"resolution": 64})
        mi.render(scene)
        parts = [weakref.ref(part) for part in (scene.integrator(), *find_media(scene))]
        del scene
        assert len(parts) == 2 and not any(part() for part in parts)
    finally:
        gc.enable()


def test_empty_field_is_black_and_clear(tmp_path):
    path = tmp_path / "empty.safetensors"
    field_file.save(path, *fields.empty(), np.float32)
    for visibility in ("raymarch", "transmittance_map", "neural_transmittance", "none"):
        image = scenes.render(scenes.scene(path, nrf(visibility), {"light": scenes.light("directional")}, size=8))
        assert (image == 0).all()


def ball_scene(path, integrator, lights, size=32, spp=64, resolution=256):
    """Return a field of identity similarity seen along −z by an orthographic camera over [−1, 1]²."""
    return mi.load_dict({
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": scenes.film(size),
            "sampler": {"type": "independent", "sample_count": spp},
        },
        "ball": {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "nrf", "filename": str(path),
                                                                           "resolution": resolution}},
        **lights,
    })  # fmt: skip


HEAD_ON = {"light": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 3.0}}}


def test_opaque_sphere_is_a_lambert_sphere(tmp_path):
    """L = k E cos θ/π on a sphere lit from the camera; self-shadows are the skin's own alone."""
    path = tmp_path / "opaque.safetensors"
    header, tensors = fields.blobs([(0, 0, 0)], [0.8], log_density=6.4, edge=60, albedo=(0.5, 0.5, 0.5), specular=1e-6)
    field_file.save(path, header, tensors, np.float32)
    # Voxels hold means of ln σ: finer ones keep the skin as thin as it was made.
    image = scenes.render(ball_scene(path, nrf("none", samples=1024), HEAD_ON, resolution=320))
    c = (np.arange(32) + 0.5) / 16 - 1
    x, y = np.meshgrid(c, -c)
    rho = np.hypot(x, y) / 0.8
    inner = rho < 0.8
    truth = 0.5 * 3 / np.pi * np.sqrt(np.maximum(1 - rho**2, 0))
    # The level set of the Gaussian is exactly 0.8; the skin is 0.01 thick, which shifts cos θ by up to 2 % at ρ = 0.8.
    np.testing.assert_allclose(image[inner][:, 0], truth[inner], rtol=0.04)
    np.testing.assert_allclose(image[inner][:, 3], 1, atol=2e-3)
    assert (image[rho > 1.1][:, 3] == 0).all()
    # With the shadow march the light passes the skin, half of it is lost there, and the phase function makes up for it.
    marched = scenes.render(ball_scene(path, nrf("raymarch", samples=1024), HEAD_ON, resolution=320))
    np.testing.assert_allclose(marched[inner][:, 0] / image[inner][:, 0], 1, rtol=0.06)  # 64 spp, two renders
    assert (marched[inner][:, 0] / image[inner][:, 0]).mean() == pytest.approx(1, abs=0.02)


def test_uniform_ball_has_the_closed_form_opacity(tmp_path):
    """α = 1 − exp(−2 σ sqrt(1 − ρ²))."""
    path = tmp_path / "uniform.safetensors"
    field_file.save(path, *fields.uniform(0.7), np.float32)
    image = scenes.render(ball_scene(path, nrf("none"), HEAD_ON))
    c = (np.arange(32) + 0.5) / 16 - 1
    rho = np.hypot(*np.meshgrid(c, c))
    inner = rho < 0.9
    truth = 1 - np.exp(-2 * 0.7 * np.sqrt(np.maximum(1 - rho**2, 0)))
    # Voxels of 1/128 at the sphere's surface, and the noise of 64 jittered rays of different chords.
    np.testing.assert_allclose(image[inner][:, 3], truth[inner], atol=0.015)
    assert image[inner][:, 3].mean() == pytest.approx(truth[inner].mean(), abs=0.003)


def side(image) -> np.ndarray:
    """Return the unit vector in the picture from the middle of the silhouette to the middle of the light on it."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    middle = [np.array([(w * x).sum(), (w * y).sum()]) / w.sum() for w in (image[..., :3].sum(-1), image[..., 3])]
    shift = middle[0] - middle[1]
    assert np.linalg.norm(shift) > 1  # pixels: the light does come from a side
    return shift / np.linalg.norm(shift)


def test_orientation(blobs):
    """nrf, volpath, and path on spheres in the field's place show light from the same side."""
    similarity = scenes.SIMILARITY
    spheres = {
        f"s{i}": {
            "type": "sphere",
            "center": [float(o + similarity.radius * v) for o, v in zip(similarity.center, c, strict=True)],
            "radius": similarity.radius * r * 0.98,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}},
        }
        for i, (c, r) in enumerate(zip(scenes.CENTERS, scenes.RADII, strict=True))
    }
    image = np.zeros((16, 32, 3), np.float32)
    image[5, 9] = 100  # one texel: light from one direction
    env = {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 40)}
    for emitter, extra in ((scenes.light("directional"), {}), (env, {"environment_lights": 512})):
        lights = {"light": emitter}
        ours = scenes.render(scenes.scene(blobs, nrf(**extra), lights, spp=16))
        volpath = scenes.scene(blobs, {"type": "volpath", "max_depth": 2, "hide_emitters": True}, lights)
        volpath = scenes.render(volpath)
        mesh = scenes.scene(
            None, {"type": "path", "max_depth": 2, "hide_emitters": True}, lights, shapes=spheres
        )
        mesh = scenes.render(mesh)

        lit = [side(image) for image in (ours, volpath, mesh)]
        # Normals of the blobs point away from the field's origin, not each ball's own: shading differs, sides do not.
        assert np.dot(lit[0], lit[1]) > 0.99 and np.dot(lit[0], lit[2]) > 0.8


def test_background_and_alpha(blobs):
    """A visible environment makes pixels opaque; with a hidden one alpha is the opacity."""
    lights = {"light": scenes.light("env")}
    shown = scenes.render(scenes.scene(blobs, nrf("none", hide_emitters=False), lights))
    hidden = scenes.render(scenes.scene(blobs, nrf("none"), lights))
    assert (shown[..., 3] == 1).all()
    corner = hidden[..., 3] == 0
    assert corner.any() and (hidden[..., 3] > 0.99).any()
    reference = scenes.scene(None, {"type": "path", "max_depth": 2}, lights)
    # The empty corner sees the map itself; 64 jittered rays of 16 spp against as many others.
    np.testing.assert_allclose(shown[corner][:, :3].mean(0), scenes.render(reference)[corner][:, :3].mean(0), rtol=0.02)


def test_seeds_spp_and_chunks(blobs, monkeypatch):
    """One seed gives one image; chunks of pixels change the noise but not the mean."""
    loaded = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=32)
    first = scenes.render(loaded, 3)
    # Samples are added to their pixels atomically, in any order: float32 sums differ in the last bits.
    np.testing.assert_allclose(first, scenes.render(loaded, 3), rtol=2e-6, atol=1e-7)
    assert np.abs(first - scenes.render(loaded, 4)).max() > 1e-3
    error = [np.abs(scenes.render(loaded, 1, spp=n) - scenes.render(loaded, 2, spp=512)).mean() for n in (4, 64)]
    assert error[1] < error[0] / 2.5  # sixteen times the samples: a quarter of the error
    monkeypatch.setattr("mi_ntf.render.transport.rendering.CHUNK", 1000)
    assert scenes.render(loaded, 3).mean() == pytest.approx(first.mean(), rel=0.02)


def test_crop_window(blobs):
    """A crop shows the same pixels as the whole picture."""
    loaded = scenes.scene(blobs, nrf(), {"light": scenes.light("directional")}, size=32)
    whole = scenes.render(loaded, spp=1024)
    parameters = mi.traverse(loaded)
    parameters["sensor.film.crop_size"], parameters["sensor.film.crop_offset"] = [12, 8], [10, 14]
    parameters.update()
    crop = scenes.render(loaded, spp=1024)
    assert crop.shape == (8, 12, 4)
    np.testing.assert_allclose(crop, whole[14:22, 10:22], atol=0.05)  # alpha at an edge: ½/√1024, times three
    assert np.corrcoef(crop.ravel(), whole[14:22, 10:22].ravel())[0, 1] > 0.99


def test_timeout_ends_early(blobs, monkeypatch):
    monkeypatch.setattr("mi_ntf.render.transport.rendering.CHUNK", 256)
    loaded = scenes.scene(blobs, nrf(timeout=1e-3), {"light": scenes.light("env")}, size=64)
    start = time.monotonic()
    image = scenes.render(loaded)
    assert time.monotonic() - start < 60
    assert (image[32:] == 0).all()  # 16 of 4096 pixels were begun


def test_develop_false_leaves_the_image_in_the_film(blobs):
    """The stock program calls render(develop=False) and then writes the film."""
    loaded = scenes.scene(blobs, nrf("none"), {"light": scenes.light("point")}, size=16)
    loaded.integrator().render(loaded, 0, seed=5, spp=4, develop=False)
    np.testing.assert_allclose(np.array(loaded.sensors()[0].film().develop()), scenes.render(loaded, 5, 4), atol=1e-6)


def test_placement_by_to_world_and_scale(tmp_path):
    """An object of twice the size, moved with its light, which is brightened by the square, looks the same."""
    path = scenes.write_blobs(tmp_path)
    plain = scenes.render(scenes.scene(path, nrf(), {"light": scenes.light("point")}, spp=64))
    place = mi.ScalarTransform4f().translate([1, 2, -1]).rotate([0, 1, 0], 70)
    twice = place @ mi.ScalarTransform4f().scale(2.0)
    center, radius = scenes.SIMILARITY.center, scenes.SIMILARITY.radius
    eye = [center[0] + 1.2, center[1] + 1.5, center[2] + 5]
    point = twice @ mi.ScalarPoint3f([3.4, 3.0, 2.5])
    moved = mi.load_dict({
        "type": "scene",
        "integrator": nrf(),
        "sensor": {
            "type": "perspective",
            "fov": 28,
            "to_world": place @ mi.ScalarTransform4f().look_at(
                [2 * v for v in eye], [2 * v for v in center], [0, 1, 0]),
            "film": scenes.film(64),
            "sampler": {"type": "independent", "sample_count": 64},
        },
        "ball": {
            "type": "sphere",
            "to_world": twice @ mi.ScalarTransform4f().translate(list(center)).scale(radius),
            "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(path), "to_world": place, "scale": 2.0},
        },
        "light": {"type": "point", "position": list(point), "intensity": {"type": "rgb", "value": [240, 200, 160]}},
    })  # fmt: skip
    # Equal seeds draw equal samples; float32 coordinates differ in the last digits, which flips samples at borders.
    np.testing.assert_allclose(scenes.render(moved), plain, atol=0.02)
    assert np.abs(scenes.render(moved) - plain).mean() < 1e-4


@pytest.mark.parametrize(("planes", "height", "phase", "voxels"), [
    ((), 0.02, None, 192), ((64, 90), 0.02, None, 192), ((192, 64), 0.02, None, 384), ((1024,), 0.02, None, 512),
    ((192, 64), 0.005, None, 448), ((), 0.008, None, 280), ((192, 64), 0.001, None, 512), ((192, 64), 0.005, 0.3, 384)])
def test_voxels_follow_planes_and_skins(planes, height, phase, voxels):
    """There are two voxels per texel of planes, and one for each 0.9 scale heights of a skin, 192 to 512."""
    kind = "planes" if planes else "frequency"
    network = dataclasses.replace(FAST.density, encoding=Encoding(kind, planes, 1 if planes else 0))
    header = Header(dataclasses.replace(FAST, density=network, phase=phase))
    skin = fields.skin("sphere", 3 - np.log(height), height)
    dj = backend.module(mi.variant())
    # Skins are a little thinner than their nominal height, by which the number is larger.
    assert 0 <= loaded.voxels(header, NetworkField(skin.header, skin.tensors, dj), dj) - voxels <= 16


def test_a_scene_may_name_the_voxels(blobs):
    for resolution, voxels in ((None, 256), (16, 16)):
        assert loaded.load(str(blobs), resolution).grid.resolution == voxels
