"""The z-test must catch a 2 % bias and let equal estimators pass."""

import re
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from helpers import ztest

H, W = 48, 40


@pytest.fixture(autouse=True)
def _evidence_here(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def _renders(n, seed, scale=1.0, samples=64):
    """Means of `samples` exponential samples (as skewed as radiance is) of a gradient with a black border."""
    truth = np.linspace(0.2, 2, W)[None, :, None] * np.ones((H, W, 3))
    truth[:4] = 0
    rng = np.random.default_rng(seed)
    return [scale * truth * rng.gamma(samples, 1 / samples, truth.shape) for _ in range(n)]


@pytest.mark.parametrize("block", [1, 8])
@pytest.mark.parametrize("seed", range(5))
def test_equal_estimators_pass(seed, block):
    ztest.check(_renders(8, 2 * seed), _renders(6, 1000 + seed, samples=16), "equal", block)


@pytest.mark.parametrize("block", [1, 8])
@pytest.mark.parametrize("scale", [0.98, 1.02])
def test_a_bias_of_two_percent_is_caught_and_leaves_evidence(scale, block):
    with pytest.raises(AssertionError, match=r"biased: .*; see ") as caught:
        ztest.check(_renders(8, 1, scale), _renders(8, 2), "biased", block)
    folder = Path(re.search(r"see (.*)$", str(caught.value)).group(1))
    with OpenEXR.File(str(folder / "reference.exr"), separate_channels=True) as file:
        red = file.channels()["R"].pixels
        assert red.shape == (H // block, W // block)
        assert red.mean() == pytest.approx(1.1 * (H - 4) / H, rel=0.02)  # mean of the gradient, noise 1/√(64·8·…)
    assert {f.name for f in folder.iterdir()} == {"image.exr", "reference.exr", "log10_p.exr"}


def test_a_bias_in_one_corner_is_caught():
    renders = _renders(8, 3)
    for r in renders:
        r[30:40, 30:40] *= 1.5
    with pytest.raises(AssertionError, match=r"values pass at p"):
        ztest.check(renders, _renders(8, 4), "corner")


def test_constant_images_are_compared_by_value():
    same, off = np.full((8, 8, 3), 0.3), np.full((8, 8, 3), 0.301)
    ztest.check([same] * 4, [same * (1 + 1e-7)] * 4, "constant")
    with pytest.raises(AssertionError, match=r"0.00% of 192 values pass"):
        ztest.check([same] * 4, [off] * 4, "constant")


def test_faults_of_use_and_nan():
    image = np.ones((8, 8, 3))
    with pytest.raises(ValueError, match=r"x: 3 and 4 renders; a variance needs at least 4"):
        ztest.check([image] * 3, [image] * 4, "x")
    with pytest.raises(ValueError, match=r"shapes \(8, 8, 3\) and \(4, 8, 3\)"):
        ztest.check([image] * 4, [image[:4]] * 4, "x")
    with pytest.raises(AssertionError, match=r"NaN or infinite pixels"):
        ztest.check([image * np.nan] * 4, [image] * 4, "x")


def test_p_values_are_uniform_for_equal_normal_samples():
    rng = np.random.default_rng(5)
    p = ztest.p_values(rng.normal(size=(5, 40000)), 3 * rng.normal(size=(9, 40000)))
    for q in (0.01, 0.1, 0.5):
        # Welch's approximation is 15 % off in the tail at these sizes; counting noise is 5 % at q = 0.01.
        assert (p < q).mean() == pytest.approx(q, rel=0.25)


def test_block_means_by_hand():
    image = np.arange(6 * 5 * 1, dtype=float).reshape(6, 5, 1)
    np.testing.assert_allclose(ztest.block_means(image, 2)[..., 0], [[3, 5], [13, 15], [23, 25]])


def test_block_difference_finds_two_percent_and_ignores_black():
    reference = np.ones((16, 24, 3))
    reference[:8, :8] = 1e-6
    image = reference * 1.02
    image[:8, :8] = 2e-6
    difference = ztest.block_difference(image, reference)
    assert difference.shape == (2, 3)
    assert difference[0, 0] == pytest.approx(1e-6 / 0.05)
    np.testing.assert_allclose(difference[1], 0.02, rtol=1e-9)
