"""The logistic transmittance: range, order, its logarithm, and digits kept in float32."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from mi_ntf.core import logistic, ops

places = st.floats(-1.2, 1.2)
slopes = st.floats(np.exp(-6.5), np.exp(6.5))
raws = st.floats(allow_nan=False, allow_infinity=False, width=32)


@given(places, places, slopes, places)
def test_transmittance_lies_in_the_unit_interval_and_is_monotone(t0, t1, a, b):
    t0, t1 = sorted((t0, t1))
    low, high = (logistic.transmittance(ops, np.float64(t), a, b) for t in (t0, t1))
    assert 0 <= low <= high <= 1
    assert low == pytest.approx(expit(a * (t0 - b)), rel=1e-12, abs=1.9e-35)  # the clip at e^−80


@given(places, slopes, places)
def test_optical_depth_is_minus_the_logarithm(t, a, b):
    depth = logistic.optical_depth(ops, t, a, b)
    z = a * (t - b)
    # ln(1 + e^−z) by NumPy's own stable form; τ itself underflows for half of these inputs.
    assert depth == pytest.approx(np.logaddexp(0, -z), rel=1e-13, abs=1e-15)
    if abs(z) < 30:
        assert depth == pytest.approx(-np.log(logistic.transmittance(ops, t, a, b)), rel=1e-6, abs=1e-13)


@given(raws, raws, st.floats(0.0625, 1, width=32))
def test_parameters_are_bounded_and_finite_for_every_float32(raw_a, raw_b, h):
    a, b = logistic.parameters(ops, np.float32(raw_a), np.float32(raw_b), np.float32(h))
    assert np.exp(-6.5) * (1 - 1e-5) <= a <= np.exp(6.5) * (1 + 1e-5)  # float32 tanh, 1e-7 · 6.5, exponentiated
    assert abs(b) <= logistic.MAX_CENTRE * h * (1 + 1e-6)
    assert np.isfinite(logistic.transmittance(ops, np.float32(0.3), a, b))
    assert np.isfinite(logistic.optical_depth(ops, np.float32(-0.3), a, b))


@given(st.floats(-40, 40))
def test_tanh_and_softplus_equal_numpys(z):
    assert logistic.tanh(ops, z) == pytest.approx(np.tanh(z), abs=3e-16 * 2)
    assert logistic.softplus(ops, z) == pytest.approx(np.logaddexp(0, z), rel=1e-13, abs=1e-15)


@pytest.mark.parametrize("z", [-1e30, -1000, -89, 89, 1000, 1e30])
def test_extremes_stay_finite_in_float32(z):
    z = np.float32(z)
    with np.errstate(all="raise", under="ignore"):
        assert logistic.sigmoid(ops, z) == pytest.approx(float(z > 0), abs=1e-30)
        assert logistic.softplus(ops, z) == pytest.approx(max(float(z), 0.0), abs=1e-30)


@given(st.floats(-1, 1), st.floats(0.02, 600))
def test_through_quantiles_inverts_the_logistic(b, a):
    t75, t50, t25 = (b + np.log(p / (1 - p)) / a for p in (0.75, 0.5, 0.25))
    a2, b2 = logistic.through_quantiles(ops, t75, t50, t25, 1.0)
    assert a2 == pytest.approx(a, rel=1e-9)  # t75 − t25 down to 0.004, its rounding 2e-16, and more
    assert b2 == pytest.approx(b, abs=4e-16 * (1 + 1 / a))  # each crossing, up to 1 + 1.1/a, is rounded by 1e-16


@pytest.mark.parametrize("cos", [1, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05])
@pytest.mark.parametrize("place", [lambda tau: -np.log(-np.log(tau)), np.log], ids=["rising skin", "constant skin"])
def test_through_quantiles_is_right_on_average_for_a_camera(place, cos):
    """Skin of a plane, seen at a cosine of 2/3: the optical depth towards the camera is drawn as free flight draws it,
    that towards the light is 2/(3 cos) times as much. One logistic is off by 0.03 where it passes its quartiles."""
    depth = -np.log((np.arange(20000) + 0.5) / 20000) * 2 / (3 * cos)
    tau = np.exp(-depth)
    t = place(np.maximum(tau, 1e-300))
    a, b = logistic.through_quantiles(ops, *map(place, (0.75, 0.5, 0.25)), cos)
    assert logistic.transmittance(ops, t, a, b).mean() == pytest.approx(tau.mean(), abs=4e-3)


def test_through_quantiles_of_a_step_has_the_largest_slope():
    a, b = logistic.through_quantiles(ops, np.float64(0.2), np.float64(0.2), np.float64(0.2), 1.0)
    assert (a, b) == (665.0, 0.2)
