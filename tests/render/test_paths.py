"""Paths of more than one bounce, between surfaces and between fields, against known sums and stock ``volpath``."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.stats
from helpers import fields, pictures, scenes, ztest

from mi_ntf.core.architecture import Similarity
from mi_ntf.render.transport import camera_light

ALBEDO = 0.9
"""Of the furnace: a closed ball that shines and reflects alike everywhere, so that every radiance is a known sum."""
SEEDS = 8


@pytest.fixture(scope="module")
def nothing(tmp_path_factory):
    """A field without matter."""
    return pictures.save(tmp_path_factory.mktemp("field"), fields.empty())


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """A field of σ = 1 in the whole unit sphere."""
    return pictures.save(tmp_path_factory.mktemp("field"), fields.uniform(1.0))


@pytest.fixture(scope="module")
def furnace(nothing):
    """Return a function of the depth: pictures (SEEDS, 32, 32) by one sample per pixel from within the ball."""
    @cache
    def render(depth):
        scene = mi.load_dict({
            "type": "scene", "integrator": {"type": "nrf", "visibility": "raymarch", "max_depth": depth},
            "sensor": pictures.camera((0, 0, 2), fov=60.0, size=32),
            "room": {"type": "sphere", "radius": 5.0, "flip_normals": True,
                     "bsdf": {"type": "diffuse", "reflectance": ALBEDO},
                     "emitter": {"type": "area", "radiance": 1.0}},
            "field": pictures.ball(nothing, resolution=16)})  # fmt: skip
        return np.stack([scenes.render(scene, seed, 1)[..., 0] for seed in range(SEEDS)]).astype(np.float64)

    return render


@pytest.mark.parametrize("depth", [2, 9])
def test_radiance_of_a_furnace(furnace, depth):
    """The radiance is the sum of albedoᵏ over the bounces, by a z-test with 8192 paths.

    Emitter and BSDF samples share each bounce, and surviving paths represent those that Russian roulette ends.
    """
    values, truth = furnace(depth), (1 - ALBEDO**depth) / (1 - ALBEDO)
    error = values.std() / np.sqrt(values.size)
    assert error < 0.005 * truth  # measured 0.2 % at depth 9; at depth 2 samples of a ball from within do not vary
    assert abs(values.mean() - truth) < 4 * error + 1e-4 * truth  # shadow rays that end short of the light


def test_renders_of_two_seeds_are_independent(furnace):
    """The correlation is 0 within 4 standard errors."""
    values = furnace(9)
    values = (values - values.mean()) / values.std()
    assert abs((values[1:] * values[:-1]).mean()) < 4 / np.sqrt(values[1:].size)


def test_paths_of_neighbouring_pixels_are_independent(nothing):
    """Neighbours sample all 256 pairs of 16 suns equally often, by χ² of 65536 pixels.

    The suns have one direction. Streams with equal starts and different increments would fail.
    """
    suns = {f"sun_{i}": pictures.sun((0, 0, 1), np.pi * (i + 1)) for i in range(16)}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "nrf", "visibility": "raymarch"},
        "sensor": pictures.camera((0, 0, 2), fov=20.0, size=256), **suns,
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 1.0}},
        "field": pictures.ball(nothing, resolution=16)})  # fmt: skip
    sampled = scenes.render(scene, 1, 1)[..., 0] / 16 - 1  # each for all 16
    np.testing.assert_allclose(sampled, np.round(sampled), atol=1e-4)
    sampled = np.round(sampled).astype(int)
    for shift in ((0, 1), (0, 2), (0, 3), (1, 0)):
        pairs = 16 * sampled + np.roll(sampled, shift, (0, 1))
        assert scipy.stats.chisquare(np.bincount(pairs.ravel(), minlength=256)).pvalue > 1e-4


def test_light_from_field_to_field(tmp_path):
    """Light of one ball of smoke on another agrees with volpath.

    A lamp lights one ball; the camera sees what the other scatters, a fifth of the picture's light. The z-test is of
    4×4 block means; the mean of that half agrees within 6 %, four standard errors.
    """
    balls = {}
    for name, x in (("left", -1.2), ("right", 1.2)):
        smoke = fields.uniform(4.0, similarity=Similarity((x, 0.0, 0.0), 1.0), albedo=(0.9,) * 3, specular=0.05)
        balls[name] = pictures.ball(pictures.save(tmp_path, smoke, name), resolution=32) | {"center": [x, 0, 0]}
    towards_left = mi.ScalarTransform4f().look_at([3, 5, 2], [-1.2, 0, 0], [0, 0, 1])

    def renders(integrator, spp):
        scene = mi.load_dict({
            "type": "scene", "integrator": {**integrator, "max_depth": 3},
            "sensor": pictures.camera((-3, 2, 6), fov=36.0, size=16), **balls,
            "spot": {"type": "spot", "to_world": towards_left, "cutoff_angle": 9.0, "intensity": 100.0}})  # fmt: skip
        return [scenes.render(scene, seed, spp)[..., :3] for seed in range(SEEDS)]

    ours, theirs = renders(scenes.nrf(bounces="paths", samples=256), 512), renders({"type": "volpath"}, 2048)
    ztest.check(ours, theirs, "field to field", block=4)
    ours, theirs = (np.array([image[:, 9:].mean() for image in images]) for images in (ours, theirs))
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.06)


@pytest.mark.parametrize(("across", "chord"), [(0.0, 2.0), (0.8, 1.2), (1.5, 0.0)])
def test_a_mirrored_lamp_is_dimmed_by_the_field_before_it(smoke, across, chord):
    """A ball of smoke between a mirror and a lamp attenuates its reflection by e^(−σ chord)."""
    to_world = mi.ScalarTransform4f().translate([0, 0, -2])
    image = pictures.render("raymarch", {
        "sensor": pictures.camera((-6, across, 1), (-2.4, across, -2), fov=0.01, size=2),
        "mirror": {"type": "rectangle", "to_world": to_world.scale(20), "bsdf": {"type": "conductor"}},
        "lamp": {"type": "rectangle", "to_world": to_world.translate([0, 0, 20]).rotate([1, 0, 0], 180).scale(90),
                 "emitter": {"type": "area", "radiance": 3.0}},
        "ball": pictures.ball(smoke, resolution=128)}, spp=1)  # fmt: skip
    # The sphere's surface cuts voxels of 1/64: 0.013 of optical depth at most.
    np.testing.assert_allclose(image[..., :3], 3 * np.exp(-chord), rtol=0.02)


@pytest.mark.parametrize("bsdf", ["diffuse", "conductor"])
def test_a_single_path_on_a_surface(smoke, monkeypatch, bsdf):
    """A picture where one camera ray of all meets the surface: the sample of its BSDF ended the process."""
    widths = []
    plain = camera_light.join
    monkeypatch.setattr(camera_light, "join", lambda parts: (
        widths.append([dr.width(paths.pixel) for paths in parts]), plain(parts))[1])
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "nrf", "visibility": "raymarch", "max_depth": 3},
        "sensor": pictures.camera((0, 0, 6), fov=40.0, size=33),
        "bead": {"type": "sphere", "center": [0, 0, 2], "radius": 0.06, "bsdf": {"type": bsdf}},
        "field": pictures.ball(smoke, resolution=16), "lamp": {"type": "point", "position": [2, 2, 4]}})
    assert scenes.render(scene, 0, 1)[..., :3].max() > 0
    assert widths and all(parts[0] == 1 for parts in widths)
