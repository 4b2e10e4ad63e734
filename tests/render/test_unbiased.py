"""`unbiased`: lookups whose mean over seeds is that of the march, however wrong they are by themselves."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from helpers import scenes, ztest

from mi_ntf.infer.visibility import REGISTRY

SEEDS = 6
OTHER = scenes.Similarity((1.3, 0.6, 1.2), 0.5)


class Spoilt:
    """A method whose answers are a fifth too dark, and as much again by a pattern."""

    def __init__(self, method):
        self.method = method

    def tau(self, x, wi, distance, index, active, sun=None):
        return self.method.tau(x, wi, distance, index, active) * (0.8 + 0.28 * dr.sin(50 * x[0]))


@pytest.fixture
def spoilt(monkeypatch):
    def build(plain):
        return lambda *arguments: Spoilt(plain(*arguments))

    for name in ("transmittance_map", "transmittance_atlas"):
        monkeypatch.setitem(REGISTRY, name, replace(REGISTRY[name], build=build(REGISTRY[name].build)))


def pictures(field, visibility, light, unbiased=False, **shapes):
    loaded = scenes.scene(field, scenes.nrf(visibility, unbiased=unbiased, environment_lights=16, samples=96,
                                            map_resolution=64), {"light": scenes.light(light)},
                          size=16, spp=64, shapes=shapes or None)
    return [scenes.render(loaded, seed)[..., :3] for seed in range(SEEDS)]


@pytest.mark.parametrize(("visibility", "light"), [
    ("transmittance_map", "point"), ("transmittance_map", "env"), ("transmittance_atlas", "env")])
def test_spoilt_lookups_are_corrected(blobs, spoilt, visibility, light):
    """A z-test of blocks against the march passes; without the correction pictures are a fifth too dark."""
    march = pictures(blobs, "raymarch", light)
    corrected = pictures(blobs, visibility, light, unbiased=True)
    ztest.check(corrected, march, f"{visibility}, {light}", block=4)
    assert np.mean(corrected) == pytest.approx(np.mean(march), rel=0.02)
    assert np.mean(pictures(blobs, visibility, light)) < 0.9 * np.mean(march)


def test_products_of_two_fields_are_corrected(blobs, spoilt):
    """One field in the shadow of another: their marches are drawn independently, or the product would be off."""
    size = OTHER.radius / scenes.SIMILARITY.radius
    place = scenes.mi.ScalarTransform4f().translate(
        (np.array(OTHER.center) - size * np.array(scenes.SIMILARITY.center)).tolist()).scale(size)
    other = scenes.ball(blobs, OTHER, to_world=place)
    march = pictures(blobs, "raymarch", "point", other=other)
    corrected = pictures(blobs, "transmittance_map", "point", True, other=other)
    ztest.check(corrected, march, "two fields", block=4)
    spread = np.std(np.mean(corrected, (1, 2, 3)), ddof=1) / SEEDS**0.5
    assert abs(np.mean(corrected) - np.mean(march)) < 4 * spread < 0.08 * np.mean(march)


def test_the_march_has_nothing_to_correct(blobs):
    one, other = (pictures(blobs, "raymarch", "point", unbiased)[0] for unbiased in (False, True))
    np.testing.assert_array_equal(one, other)
