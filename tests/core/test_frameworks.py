"""Every formula of core in NumPy float64, PyTorch float32 and Dr.Jit float32: values and gradients, from one list.

Inputs are rounded to float32 first, so all three see the same numbers. The gradient oracle is the central difference of
the NumPy float64 formula.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from helpers.frameworks import BACKENDS, oracle

from mi_ntf.core import fresnel, henyey_greenstein, logistic, microfacet, ops, spheres, srgb

COUNT = 4000
STEP = 1e-6
"""Of the central difference, relative to each input's size: truncation 1e-12·f‴, rounding 1e-16/1e-6."""


def _uniform(low, high):
    return lambda rng: [rng.uniform(low, high, COUNT)]


def _log_uniform(low, high):
    return lambda rng: [np.exp(rng.uniform(np.log(low), np.log(high), COUNT))]


def _point(rng):
    return list(rng.uniform(-0.55, 0.55, (3, COUNT)))


def _direction(rng):
    v = rng.normal(size=(3, COUNT))
    return list(v / np.linalg.norm(v, axis=0))


@dataclass(frozen=True)
class Formula:
    """`function(ops, *scalars)` → scalars; `inputs`: samplers; tolerances relative to max(|oracle|, `unit`)."""

    name: str
    function: Callable
    inputs: tuple
    value: float
    gradient: float
    unit: float = 1.0
    """Size below which errors count absolutely."""


def _chord(o, x, y, z, dx, dy, dz):
    _, m, h = spheres.chord(o, (x, y, z), (dx, dy, dz))
    return *m, h


def _end_points(o, x, y, z, dx, dy, dz, h):
    p1, p2 = spheres.end_points((x, y, z), (dx, dy, dz), h)
    return *p1, *p2


T, B = _uniform(-1, 1), _uniform(-1.1, 1.1)
GENTLE, STEEP = _log_uniform(0.01, 20), _log_uniform(20, 665)
# z = a (t − b) carries 3 roundings of 6e-8·|z|; where S(z) is not yet flat |z| < 15 for gentle slopes: 1e-6. Steep ones
# subtract t − b exactly in part, then multiply: 665·1e-7/4 = 2e-5 of τ, and a·that of its derivatives (unit = a).
FORMULAS = [
    Formula("chord", _chord, (_point, _direction), 1e-6, 5e-6),
    Formula("end_points", _end_points, (_point, _direction, _uniform(0.05, 1)), 5e-7, 5e-7),
    Formula("coordinate", lambda o, *c: [spheres.coordinate(c[:3], c[3:])], (_point, _direction), 5e-7, 5e-7),
    Formula("sigmoid", lambda o, z: [logistic.sigmoid(o, z)], (_uniform(-90, 90),), 5e-7, 5e-7),
    Formula("softplus", lambda o, z: [logistic.softplus(o, z)], (_uniform(-90, 90),), 5e-7, 5e-7),
    Formula("tanh", lambda o, z: [logistic.tanh(o, z)], (_uniform(-20, 20),), 5e-7, 5e-7),
    Formula("transmittance", lambda o, *c: [logistic.transmittance(o, *c)], (T, GENTLE, B), 3e-6, 6e-6),
    Formula("transmittance, steep", lambda o, *c: [logistic.transmittance(o, *c)], (T, STEEP, B), 5e-5, 1e-4, 665.0),
    Formula("optical_depth", lambda o, *c: [logistic.optical_depth(o, *c)], (T, GENTLE, B), 3e-6, 6e-6),
    Formula("optical_depth, steep", lambda o, *c: [logistic.optical_depth(o, *c)], (T, STEEP, B), 1e-6, 1e-4, 100.0),
    # ln a is 6.5 tanh: 6.5·2e-7 of a; derivative likewise.
    Formula("parameters", lambda o, *c: logistic.parameters(o, *c), (_uniform(-12, 12), _uniform(-5, 5),
            _uniform(0.05, 1)), 3e-6, 1e-5),
    # t75 − t25 ≥ 0.04, rounded by 1e-7. ∂a/∂b is the difference of two terms 2.2/0.04², each rounded by 6e-8.
    Formula("through_quantiles", lambda o, b, u, v, c: logistic.through_quantiles(o, b + u, b, b - v, c),
            (T, _log_uniform(0.02, 1), _log_uniform(0.02, 1), _log_uniform(0.01, 1)), 3e-6, 3e-5, 10.0),
    # dD/dα is a difference of two terms 1000 times its value where it crosses zero.
    Formula("ggx", lambda o, s, a: [microfacet.ggx(s, a)], (_uniform(0, 1), _log_uniform(0.0225, 1)), 1e-6, 3e-5),
    Formula("distribution", lambda o, s, a, t: [microfacet.distribution(o, s, a, t)],
            (_uniform(0, 1), _log_uniform(0.0225, 1), _uniform(0.02, 1)), 1e-5, 1e-3),
    Formula("smith, tail", lambda o, c, a, t: [2 * c * microfacet.smith(o, c, a, t)],
            (_uniform(0, 1), _log_uniform(0.0225, 1), _uniform(0.02, 1)), 1e-6, 3e-5),
    Formula("smith", lambda o, c, a: [2 * c * microfacet.smith(o, c, a)], (_uniform(0, 1), _log_uniform(0.0225, 1)),
            1e-6, 3e-6),
    # Directions rounded by 6e-8 under a lobe of width α ≥ 0.0225: 6e-8/α per order of derivative, unit peak-relative.
    Formula("lobes", lambda o, *c: microfacet.lobes(o, c[:3], c[3:6], c[6:9], c[9]),
            (_direction, _direction, _direction, _uniform(0.15, 1)), 2e-5, 2e-4),
    Formula("scattering", lambda o, *c: microfacet.scattering(o, c[:3], c[3:6], c[6:9], c[9]),
            (_direction, _direction, _direction, _uniform(0.15, 1)), 2e-5, 2e-4),
    Formula("lobes, collocated", lambda o, c, r: microfacet.lobes_collocated(o, c, r),
            (_uniform(-1, 0.999), _uniform(0.15, 1)), 2e-5, 2e-4),
    # ⟨ω_o,h⟩ is a root, of slope 1/(2 cos), at 1e-12 under it: 2e-4 of directions are within 1e-3 of opposite.
    Formula("fresnel", lambda o, *c: fresnel.weights(o, c[:3], c[3:6], c[6:9], c[9], c[10], c[11]),
            (_direction, _direction, _direction, _uniform(0.15, 1), _uniform(0.02, 0.98), _uniform(0, 1)), 3e-6, 1e-4),
    Formula("fresnel, collocated", lambda o, *c: fresnel.weights_collocated(o, *c),
            (_uniform(-1, 0.999), _uniform(0.15, 1), _uniform(0.02, 0.98), _uniform(0, 1)), 3e-6, 1e-5),
    Formula("diffuse_albedo, fresnel", lambda o, *c: [fresnel.diffuse_albedo(o, *c, True)],
            (_uniform(0, 1), _uniform(0.15, 1), _uniform(0.02, 0.98)), 5e-7, 5e-6),
    Formula("diffuse_albedo", lambda o, *c: [microfacet.diffuse_albedo(*c)],
            (_uniform(0, 1), _uniform(0.15, 1), _uniform(0, 1)), 5e-7, 5e-7),
    # 1 + g² − 2 g cos ≥ 0.01 is the difference of numbers that are rounded by 1e-7.
    Formula("phase of smoke", lambda o, g, c: [henyey_greenstein.phase(o, g, c)],
            (_uniform(-0.9, 0.9), _uniform(-1, 1)), 5e-5, 2e-4),
    Formula("deflection", lambda o, g, u: [henyey_greenstein.deflection(g, u)],
            (_uniform(-0.9, 0.9), _uniform(0, 1)), 2e-5, 1e-3),
    Formula("normalize", lambda o, *c: ops.normalize(o, c), (_point,), 5e-7, 1e-5, 1.0),
    Formula("sRGB", lambda o, x: [srgb.encode(o, x)], (_uniform(-0.2, 1.2),), 5e-7, 5e-6),
    Formula("sRGB, back", lambda o, x: [srgb.decode(o, x)], (_uniform(0, 1),), 5e-7, 5e-6),
]


def _inputs(formula):
    rng = np.random.default_rng(17)
    return [np.float32(v) for sample in formula.inputs for v in sample(rng)]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("formula", FORMULAS, ids=lambda f: f.name)
def test_values_and_gradients(formula, backend):
    inputs = _inputs(formula)
    expected, expected_gradients = oracle(formula.function, inputs, STEP)
    values, gradients = BACKENDS[backend](formula.function, inputs)
    for value, truth in zip(values, expected, strict=True):
        assert value.dtype == np.float32
        error = np.abs(value - truth) / np.maximum(np.abs(truth), 1.0)
        assert error.max() <= formula.value, f"worst input {[float(v[error.argmax()]) for v in inputs]}"
    if gradients is None:
        return
    for gradient, truth in zip(gradients, expected_gradients, strict=True):
        assert np.isfinite(gradient).all()
        error = np.abs(gradient - truth) / np.maximum(np.abs(truth), formula.unit)
        assert error.max() <= formula.gradient, f"worst input {[float(v[error.argmax()]) for v in inputs]}"


def _opposite(o, x):
    wi, wo = (0.6 * x, 0 * x, 0.8 * x), (-0.6 * x, 0 * x, -0.8 * x)
    return microfacet.lobes(o, wi, wo, (0 * x, 0 * x, x), 0.2 * x)


SINGULAR = {
    "tangent line": (lambda o, x: _chord(o, x, 0 * x, 0 * x, 0 * x, 0 * x, x), 1.0),
    "line far outside": (lambda o, x: _chord(o, 50 * x, 0 * x, 0 * x, 0 * x, 0 * x, x), 1.0),
    "line through the centre": (lambda o, x: _chord(o, 0 * x, 0 * x, x, 0 * x, 0 * x, x), 1.0),
    "huge logit": (lambda o, x: [logistic.sigmoid(o, x), logistic.sigmoid(o, -x), logistic.softplus(o, x)], 1e30),
    "huge raw parameters": (lambda o, x: logistic.parameters(o, x, -x, 0.5 + 0 * x), 1e30),
    "coinciding quantiles": (lambda o, x: logistic.through_quantiles(o, x, x, x, 0 * x), 0.3),
    "grazing both": (lambda o, x: microfacet.lobes(o, (1 + 0 * x, x, x), (x, 1 + 0 * x, x), (x, x, 1 + 0 * x), 1 + x),
                     0.0),
    "opposite directions": (_opposite, 1.0),
    "zero vector": (lambda o, x: ops.normalize(o, (x, x, x)), 0.0),
}


@pytest.mark.parametrize("backend", ["torch", "drjit"])
@pytest.mark.parametrize("name", SINGULAR)
def test_values_and_gradients_are_finite_at_singular_points(name, backend):
    function, x = SINGULAR[name]
    values, gradients = BACKENDS[backend](function, [np.full(3, x, np.float32)])
    assert np.isfinite(values).all() and np.isfinite(gradients).all()


@pytest.mark.parametrize("backend", ["torch", "drjit"])
def test_softplus_has_slope_one_half_at_zero(backend):
    values, gradients = BACKENDS[backend](lambda o, z: [logistic.softplus(o, z)], [np.zeros(2, np.float32)])
    np.testing.assert_allclose(values[0], np.log(2), rtol=1e-7)
    np.testing.assert_array_equal(gradients[0], 0.5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["maximum", "minimum"])
def test_not_a_number_passes_through(backend, name):
    values, _ = BACKENDS[backend](
        lambda o, x: [getattr(o, name)(x, 0.0), getattr(o, name)(x * 0 + 1, x)], [np.array([np.nan, 2], np.float32)])
    assert np.isnan([v[0] for v in values]).all() and np.isfinite([v[1] for v in values]).all()
