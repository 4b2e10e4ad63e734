"""Error, noise and bias of means whose error, noise and bias are known; readings of curves in closed form."""

import numpy as np
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.tradeoff import errors
from mi_ntf.evaluate.tradeoff.errors import Estimate, Mean, Truth

TRUTH = np.linspace(0.5, 1.5, 96 * 96 * 3).reshape(96, 96, 3)
POWER = float((TRUTH**2).mean())
COUNTS = (1, 1, 2, 4, 8)
"""Samples of the passes."""


def mean_of(rng, noise, bias, truth=None, counts=COUNTS):
    """Mean of pictures whose samples have a relative noise and bias."""
    found = Mean(truth or Truth(TRUTH))
    wrong = TRUTH + bias * np.sqrt(POWER) * np.where(np.arange(96)[:, None, None] % 2, 1, -1)
    for count in counts:
        found.add(wrong + noise / np.sqrt(count) * np.sqrt(POWER) * rng.normal(size=TRUTH.shape), count)
    return found


def z(estimate: Estimate, value: float) -> float:
    """Standard errors between an estimate and the true error."""
    return (estimate.square - value**2) / estimate.deviation


@pytest.mark.parametrize(("noise", "bias"), [(0.4, 0.03), (0.08, 0.05), (0.2, 0.0)])
def test_error_noise_and_bias_are_those_of_the_pictures(rng, noise, bias):
    found = mean_of(rng, noise, bias)
    left = noise / 4  # of 16 samples
    spread, stays = found.split()
    assert found.samples == 16 and found.pictures == len(COUNTS)
    assert abs(z(found.error(), np.hypot(left, bias))) < 4
    assert abs(z(spread, left)) < 4 and abs(z(stays, bias)) < 4
    assert found.error().square == pytest.approx(spread.square + stays.square)
    assert spread.value == pytest.approx(left, rel=0.05)


def test_standard_errors_are_the_spread_of_the_estimates(rng):
    means = [mean_of(rng, 0.4, 0.02) for _ in range(60)]
    for kind in range(3):
        estimates = [(m.error(), *m.split())[kind] for m in means]
        deviation = np.mean([e.deviation for e in estimates])
        assert np.std([e.square for e in estimates]) == pytest.approx(deviation, rel=0.4)
    assert abs(np.mean([z(m.split()[1], 0.02) for m in means])) < 4 / np.sqrt(60)


def test_the_error_of_pure_noise_falls_with_the_square_root_of_the_samples(rng):
    found, values = Mean(Truth(TRUTH)), []
    for count in (1, 1, 2, 4, 8, 16, 32):
        found.add(TRUTH + 0.3 / np.sqrt(count) * rng.normal(size=TRUTH.shape), count)
        values.append(found.error().value * np.sqrt(found.samples))
    np.testing.assert_allclose(values, 0.3 / np.sqrt(POWER), rtol=0.03)
    np.testing.assert_allclose(found.image, TRUTH, atol=0.3)


def test_the_references_own_noise_is_taken_off(rng):
    """Without, 3 % of noise in the reference would be 3 % of bias."""
    halves = [TRUTH + 0.03 * np.sqrt(8 * POWER) * rng.normal(size=TRUTH.shape) for _ in range(8)]
    variance = float(np.var(halves, 0, ddof=1).mean() / 8)
    truth = Truth(np.mean(halves, 0), variance)
    assert truth.noise == pytest.approx(0.03, rel=0.05)
    assert abs(z(mean_of(rng, 0.05, 0.0, truth).split()[1], 0.0)) < 4
    assert mean_of(rng, 0.05, 0.0, Truth(truth.image)).split()[1].value == pytest.approx(0.03, rel=0.1)


def test_a_value_and_its_uncertainty():
    assert Estimate(0.04, 0.0).value == 0.2 and Estimate(0.04, 0.0).uncertainty == 0
    assert Estimate(-0.01, 0.0025).value == 0 and Estimate(-0.01, 0.0025).uncertainty == 0.05
    assert Estimate(0.04, 0.0004).uncertainty == pytest.approx(0.0004 / 0.4, rel=0.01)


def test_one_picture_and_black_references_are_refused(rng):
    with pytest.raises(MiNtfError, match="render two seeds"):
        mean_of(rng, 0.1, 0.0, counts=(1,)).split()
    with pytest.raises(MiNtfError, match="the reference is black"):
        mean_of(rng, 0.1, 0.0, Truth(0 * TRUTH)).error()


def test_a_difference_of_brightness_is_seen_and_none_is_not(rng):
    gap, sigma = mean_of(rng, 0.5, 0.0).shift()
    assert abs(gap) < 4 * sigma and sigma < 0.002
    found = Mean(Truth(TRUTH))
    found.add(1.02 * TRUTH + 0.1 * rng.normal(size=TRUTH.shape), 1)
    gap, sigma = found.shift()
    assert gap == pytest.approx(0.02, abs=4 * sigma) and gap > 10 * sigma


def test_the_seconds_to_an_error_are_those_of_a_power_law():
    """0.2 t^−½ is 0.05 at 16 s; points are at powers of 2."""
    seconds = [2.0**k for k in range(-1, 7)]
    values = [0.2 / np.sqrt(t) for t in seconds]
    for limit in (0.15, 0.05, 0.03):
        assert errors.crossing(seconds, values, limit) == pytest.approx((0.2 / limit) ** 2)
    assert errors.crossing(seconds, values, 0.02) is None  # nothing is extrapolated
    assert errors.crossing(seconds, values, 0.5) == 0.5  # below it from the first point on
    assert errors.crossing([1.0, 4.0], [0.2, 0.0], 0.1) == pytest.approx(2.0)  # 0 counts as half of the limit


def test_the_front_has_what_nothing_beats():
    points = [(3.0, 0.1), (1.0, 0.5), (2.0, 0.5), (2.5, 0.2), (4.0, 0.1), (0.5, 0.9), (2.6, 0.3)]
    assert [points[i] for i in errors.front(points)] == [(0.5, 0.9), (1.0, 0.5), (2.5, 0.2), (3.0, 0.1)]
    assert errors.front([]) == []
