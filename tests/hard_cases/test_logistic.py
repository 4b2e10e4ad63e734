"""Logistics and mixtures where their parameters end: slopes of 0 and 10⁵, places far from the chord, light that is all
gone, weights of 0. Values and gradients in all frameworks against closed forms in float64 that do not share our code.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from helpers.frameworks import BACKENDS, oracle
from scipy.special import expit

from mi_ntf.core import logistic, mixture

STEEPEST = 665.0


@dataclass(frozen=True)
class Case:
    """`function(ops, *inputs)` against `truth(*inputs)`; errors relative to max(|truth|, `unit`)."""

    name: str
    function: Callable
    truth: Callable
    inputs: tuple
    value: float = 1e-6
    gradient: float = 1e-5
    unit: float = 1.0
    fixed: tuple = ()
    """Inputs by which there is no derivative."""


def _mixture_depth(t, *parts):
    """−ln Σ w S(a (t − b)), in logarithms throughout."""
    with np.errstate(divide="ignore"):
        logs = [np.log(np.abs(w)) - np.logaddexp(0, -a * (t - b)) for w, a, b in parts]
    return -np.logaddexp.reduce(logs, axis=0)


def _of_two(o, t, w1, a1, b1, w2, a2, b2):
    return t, ((w1, a1, b1), (w2, a2, b2))


def _tau(o, t, a, b):
    return [logistic.transmittance(o, t, a, b)]


def _expit(o, t, a, b):
    return [expit(a * (t - b))]


def _od(o, t, a, b):
    return [logistic.optical_depth(o, t, a, b)]


def _od_truth(o, t, a, b):
    return [np.logaddexp(0, -a * (t - b))]


def _two_tau(o, *c):
    return [mixture.transmittance(o, *_of_two(o, *c))]


def _two_depth(o, *c):
    return [mixture.optical_depth(o, *_of_two(o, *c))]


def _two_tau_truth(o, t, w1, a1, b1, w2, a2, b2):
    return [w1 * expit(a1 * (t - b1)) + w2 * expit(a2 * (t - b2))]


def _two_depth_truth(o, t, *c):
    return [_mixture_depth(t, c[:3], c[3:])]


def _normalised(o, t, h, a1, b1, a2, b2, logit):
    """τ(t) of a mixture that is 1 at h, as the network's outputs make it."""
    return [mixture.transmittance(o, t, mixture.from_outputs(o, [(a1, b1), (a2, b2)], [logit], h))]


def _normalised_truth(o, t, h, a1, b1, a2, b2, logit):
    parts = (1.0, a1, b1), (np.exp(6 * np.tanh(logit / 6)), a2, b2)
    return [np.exp(_mixture_depth(h, *parts) - _mixture_depth(t, *parts))]


# z = a (t − b) is rounded by 6e-8·|z|: that times a quarter of τ, and a times it of ∂τ/∂t, whose own size is a/4.
def _quartiles(o, b, u, v):
    """The logistic through quartiles `u` above and `v` below the median `b`, lit from overhead."""
    return logistic.through_quantiles(o, b + u, b, b - v, 1 + 0 * b)


def _centre(b, u, v):
    return b + np.where(np.subtract(u, v) > 0, 0.45, 0.54) * np.subtract(u, v)


CASES = [
    Case("slope 0", _tau, _expit, ([-1, 0, 0.5, 1], [0, 1e-30, 1e-7, 0], [0.3, -0.3, 1, -1])),
    Case("slope 0 far away", _tau, _expit, ([-1e4, 1e4], [0, 1e-30], [0.3, -0.3]), gradient=1e-6, unit=1e4),
    Case("steepest slope", _tau, _expit, ([0.3, 0.301, 0.299, 0.31], [STEEPEST] * 4, [0.3] * 4), 3e-6, 3e-5, STEEPEST),
    Case("slope 1e5", _tau, _expit, ([0.5, 0.50001, 0.49999, 0.6], [1e5] * 4, [0.5] * 4), 2e-3, 2e-3, 1e5),
    Case("centre beyond the near end", _tau, _expit, ([-1, 0, 0.9], [1, 20, 30], [1.2] * 3), gradient=1e-5, unit=30),
    Case("centre beyond the far end", _tau, _expit, ([-1, 0, 0.9], [1, 20, STEEPEST], [-1.2] * 3), unit=STEEPEST),
    Case("places ±1e4", _tau, _expit, ([1e4, -1e4, 1e4, -1e4], [1, 1, STEEPEST, STEEPEST], [0.5] * 4), unit=1e4),
    Case("depth at slope 0", _od, _od_truth, ([-1, 1], [0, 1e-30], [0.3, -1])),
    Case("depth at slope 1e5", _od, _od_truth, ([0.4, 0.6, -1], [1e5] * 3, [0.5] * 3), 1e-6, 1e-6),
    Case("depth at places ±1e4", _od, _od_truth, ([1e4, -1e4, -1e4], [1, 1, STEEPEST], [0.5] * 3)),
    Case("depth of τ underflowed", _od, _od_truth, ([-0.5, -0.9, -1], [200, 400, 1e5], [0.5, 0.9, 1])),
    Case("depth of clear light", _od, _od_truth, ([0.5, 0.9, 1], [200, 400, 1e5], [-0.5, -0.9, -1])),
    Case("weight 0 of the first", _two_tau, _two_tau_truth, ([0.1], [0], [20], [0.2], [1], [30], [0.05]), 1e-6, 1e-5),
    Case("depth, weight 0 of the first", _two_depth, _two_depth_truth,
         ([0.1, -0.9], [0, 0], [20, 20], [0.2, 0.2], [1, 1], [30, 30], [0.05, 0.05]), unit=30, fixed=(1,)),
    Case("depth, weight 0 of the second", _two_depth, _two_depth_truth,
         ([0.1, -0.9], [1, 1], [20, 20], [0.2, 0.2], [0, 0], [30, 30], [0.05, 0.05]), unit=30, fixed=(4,)),
    Case("depth, weight 1e-30", _two_depth, _two_depth_truth,
         ([0.1, -0.9], [1e-30] * 2, [20] * 2, [0.2] * 2, [1, 1], [30, 30], [0.05] * 2), 1e-6, 1e-5, 30, (1,)),
    Case("depth, both underflowed", _two_depth, _two_depth_truth,
         ([-1, -1], [0.4, 0.4], [300, STEEPEST], [0.9, 0.9], [0.6, 0.6], [STEEPEST, 300], [0.9, 0.8])),
    Case("depth, equal logistics", _two_depth, _two_depth_truth,
         ([-1, 1, 0.2], [0.5] * 3, [50] * 3, [0.2] * 3, [0.5] * 3, [50] * 3, [0.2] * 3), 1e-6, 1e-5, 12.5),
    Case("τ(exit) → 0: 1e-2", _normalised, _normalised_truth,
         ([0.4, 0.5, -0.5], [0.5] * 3, [40] * 3, [0.6] * 3, [60] * 3, [0.6] * 3, [0.5] * 3), 3e-6, 3e-5, 40),
    Case("τ(exit) → 0: 1e-8", _normalised, _normalised_truth,
         ([0.4, 0.5, -0.5], [0.5] * 3, [200] * 3, [0.6] * 3, [190] * 3, [0.6] * 3, [0.5] * 3), 3e-6, 3e-5, 200),
    # Where τ(exit) is below 1e-19 its derivative underflows: the square of its denominator leaves float32.
    Case("τ(exit) → 0: 1e-15", _normalised, _normalised_truth,
         ([0.45, 0.5, -0.5], [0.5] * 3, [350] * 3, [0.6] * 3, [340] * 3, [0.6] * 3, [0.5] * 3), 2e-5, 1e-4, 350),
    Case("logits of ±1e4", _normalised, _normalised_truth,
         ([0.1, -0.2], [0.5] * 2, [20] * 2, [0.2] * 2, [60] * 2, [-0.1] * 2, [1e4, -1e4]), 3e-6, 3e-5, 60),
    Case("raw parameters of ±1e30", lambda o, *c: logistic.parameters(o, *c),
         lambda o, a, b, h: [np.exp(6.5 * np.tanh(a / 6.5)), 1.2 * h * np.tanh(b)],
         ([1e30, -1e30, 1e4], [-1e30, 1e30, 1e4], [0.5] * 3), 5e-6, 1e-5, 100),
    Case("quartiles 1e-2 apart", _quartiles,
         lambda o, b, u, v: [2 * np.log(3) / (u + v), _centre(b, u, v)],
         ([0.5, -0.5], [0.005, 0.009], [0.005, 0.001]), 3e-5, 1e-4, 2e4),
    # A kink: b moves by 0.45 and 0.54 of a bend to either side, and any slope between them is one.
    Case("quartiles that coincide", _quartiles,
         lambda o, b, u, v: [STEEPEST + 0 * b, _centre(b, u, v)], ([0.5, -0.5, 0.1], [0] * 3, [0] * 3), 1e-6, 0.05),
    Case("quartiles out of order by rounding", _quartiles,
         lambda o, b, u, v: [STEEPEST + 0 * b, _centre(b, u, v)], ([0.5, -0.5], [-1e-7, -6e-8], [0, 0]), 1e-6),
    Case("logits of ±1e30 of the sigmoid", lambda o, z: [logistic.sigmoid(o, z), logistic.softplus(o, z)],
         lambda o, z: [expit(z), np.logaddexp(0, z)], ([1e30, -1e30, 88, -88, 0],), 1e-6, 1e-6),
]  # fmt: skip


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_logistic(case, backend, check):
    inputs = [np.array(v, np.float32) for v in case.inputs]
    expected, slopes = oracle(case.truth, inputs, 1e-6)
    with np.errstate(divide="ignore"):  # NumPy warns of the logarithm of a weight 0, which is −∞ as it should be
        values, gradients = BACKENDS[backend](case.function, inputs)
    for value, truth in zip(values, expected, strict=True):
        check(case.name, backend, "value", (value - truth) / np.maximum(np.abs(truth), 1), case.value)
    if gradients is not None:
        errors = [(g - s) / np.maximum(np.abs(s), case.unit) for g, s in zip(gradients, slopes, strict=True)]
        errors = [e for k, e in enumerate(errors) if k not in case.fixed]
        check(case.name, backend, "gradient", errors, case.gradient)
