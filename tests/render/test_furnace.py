"""Light between surfaces in a closed ball that shines and reflects alike everywhere: radiances are known sums."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
import scipy.stats
from helpers import fields, pictures, scenes

ALBEDO = 0.9
SEEDS = 8


@pytest.fixture(scope="module")
def nothing(tmp_path_factory):
    """A field without matter."""
    return pictures.save(tmp_path_factory.mktemp("field"), fields.empty())


@pytest.fixture(scope="module")
def furnace(nothing):
    """``furnace(depth)``: pictures (SEEDS, 32, 32) by one sample a pixel from within the ball."""
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
    """Sum of albedoᵏ over the bounces: emitter and BSDF samples share each bounce, and the paths that go on stand for
    those that end at random. Z-test with 8192 paths."""
    values, truth = furnace(depth), (1 - ALBEDO**depth) / (1 - ALBEDO)
    error = values.std() / np.sqrt(values.size)
    assert error < 0.005 * truth  # measured 0.2 % at depth 9; at depth 2 samples of a ball from within do not vary
    assert abs(values.mean() - truth) < 4 * error + 1e-4 * truth  # shadow rays that end short of the light


def test_renders_of_two_seeds_are_independent(furnace):
    """Within 4 standard errors."""
    values = furnace(9)
    values = (values - values.mean()) / values.std()
    assert abs((values[1:] * values[:-1]).mean()) < 4 / np.sqrt(values[1:].size)


def test_paths_of_neighbouring_pixels_are_independent(nothing):
    """Of 16 suns of one direction each pixel draws one: pairs of neighbours draw all 256 pairs equally often, by χ² of
    65536 pixels. Random streams that begin at one place and differ in their increments alone do not."""
    suns = {f"sun_{i}": pictures.sun((0, 0, 1), np.pi * (i + 1)) for i in range(16)}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "nrf", "visibility": "raymarch"},
        "sensor": pictures.camera((0, 0, 2), fov=20.0, size=256), **suns,
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 1.0}},
        "field": pictures.ball(nothing, resolution=16)})  # fmt: skip
    drawn = scenes.render(scene, 1, 1)[..., 0] / 16 - 1  # each for all 16
    np.testing.assert_allclose(drawn, np.round(drawn), atol=1e-4)
    drawn = np.round(drawn).astype(int)
    for shift in ((0, 1), (0, 2), (0, 3), (1, 0)):
        pairs = 16 * drawn + np.roll(drawn, shift, (0, 1))
        assert scipy.stats.chisquare(np.bincount(pairs.ravel(), minlength=256)).pvalue > 1e-4
