"""Noise and bias of pictures whose noise and bias are known."""

import numpy as np
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.tradeoff import errors

TRUTH = np.linspace(0.5, 1.5, 96 * 96 * 3).reshape(96, 96, 3)
POWER = float((TRUTH**2).mean())


def pictures(rng, count, noise, bias):
    """`count` pictures of relative noise and bias."""
    wrong = TRUTH + bias * np.sqrt(POWER) * np.where(np.arange(96)[:, None, None] % 2, 1, -1)
    return [wrong + noise * np.sqrt(POWER) * rng.normal(size=TRUTH.shape) for _ in range(count)]


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize(("noise", "bias"), [(0.1, 0.03), (0.02, 0.05), (0.05, 0.0)])
def test_noise_and_bias_are_told_apart(rng, count, noise, bias):
    found = errors.split(pictures(rng, count, noise, bias), TRUTH)
    assert found.noise == pytest.approx(noise, rel=0.03)
    assert abs(found.bias**2 - bias**2) < 4 * found.uncertainty
    assert found.known or not bias
    assert found.total == pytest.approx(np.hypot(found.noise, found.bias)) and found.bias < found.most


def test_the_references_own_noise_is_taken_off(rng):
    """Without, 3 % of noise in the reference would be 3 % of bias."""
    halves = pictures(rng, 8, 0.03 * np.sqrt(8), 0.0)
    reference = np.mean(halves, 0)
    variance = float(np.var(halves, 0, ddof=1).mean() / 8)
    found = errors.split(pictures(rng, 2, 0.05, 0.0), reference, variance)
    assert errors.split(pictures(rng, 2, 0.05, 0.0), reference).bias == pytest.approx(0.03, rel=0.1)
    assert found.bias**2 < 4 * found.uncertainty


def test_uncertainty_is_the_spread_of_the_estimate(rng):
    found = [errors.split(pictures(rng, 2, 0.2, 0.02), TRUTH) for _ in range(40)]
    squares = [f.bias**2 for f in found if f.bias]
    assert np.std(squares) == pytest.approx(np.mean([f.uncertainty for f in found]), rel=0.35)


def test_several_points_of_equal_settings_have_one_bias():
    pooled = errors.pooled([errors.Error(0.2, 0.0, 4e-4), errors.Error(0.05, 0.02, 1e-5)])
    assert pooled.bias == pytest.approx(0.02, rel=0.01) and pooled.noise == 0.05
    assert pooled.uncertainty == pytest.approx(1e-5, rel=0.01)


def test_one_picture_and_black_references_are_refused(rng):
    with pytest.raises(MiNtfError, match="render two seeds"):
        errors.split([TRUTH], TRUTH)
    with pytest.raises(MiNtfError, match="black everywhere"):
        errors.split([TRUTH, TRUTH], 0 * TRUTH)


def test_z_test_finds_a_difference_and_none(rng):
    same = errors.z_test(pictures(rng, 8, 0.5, 0.0), pictures(rng, 8, 0.2, 0.0))
    assert same["p"] > 1e-3 and abs(same["difference"]) < 4 * same["sigma"]
    other = errors.z_test([1.02 * p for p in pictures(rng, 8, 0.2, 0.0)], pictures(rng, 8, 0.2, 0.0))
    assert other["difference"] == pytest.approx(0.02, abs=4 * other["sigma"]) and other["p"] < 1e-6
    with pytest.raises(MiNtfError, match="at least 4"):
        errors.z_test([TRUTH] * 3, [TRUTH] * 8)


@pytest.mark.parametrize(("t", "freedom"), [(0.0, 3), (1.0, 1), (2.5, 7.3), (4.0, 3), (6.0, 40)])
def test_p_is_students(t, freedom):
    from scipy.stats import t as student

    assert errors.two_sided(t, freedom) == pytest.approx(2 * student.sf(t, freedom), rel=1e-3)
