"""Softness: the phase function's cosine against Chapman's function, and its measure by marches."""

import numpy as np
import pytest
from scipy.special import erfcx

from mi_ntf.core import microfacet, ops, skin


@pytest.mark.parametrize("ratio", [20.0, 100.0, 1000.0])
def test_cosine_is_that_of_an_exponential_skin(ratio):
    """Along a ray that leaves at cosine μ, height grows as μ s + (1 − μ²) s²/2R: the depth over that along the normal
    is 1/c. `ratio`: radius over scale height."""
    horizon = np.sqrt(2 / (np.pi * ratio))
    mu = np.linspace(horizon, 1, 200)
    k = np.maximum((1 - mu**2) / (2 * ratio), 1e-9)
    y = mu / (2 * np.sqrt(k))
    exact = np.sqrt(np.pi / (4 * k)) * erfcx(y)
    ours = 1 / microfacet.soft_cosine(ops, mu, skin.CHAPMAN * horizon**2)
    np.testing.assert_allclose(ours, exact, rtol=0.035)
    # At the horizon itself c is 15 % too large.
    assert microfacet.soft_cosine(ops, 0.0, skin.CHAPMAN * horizon**2) == pytest.approx(1.15 * horizon, rel=0.01)


def test_directions_along_the_skin(rng):
    """Unit vectors across the normal, evenly around it."""
    n = rng.normal(size=(3, 500))
    n /= np.linalg.norm(n, axis=0)
    n[:, :3] = np.eye(3)
    d = np.array([skin.across(ops, tuple(n), turn) for turn in skin.TURNS])
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose((d * n).sum(1), 0, atol=1e-14)
    np.testing.assert_allclose(d.sum(0), 0, atol=1e-14)
    np.testing.assert_allclose((d[0] * d[2]).sum(0), 0, atol=1e-14)  # a quarter turn


def test_squared_horizon_and_softness():
    """c₀² is the squared ratio of the depths, less the bias of a flat skin."""
    out, along, sigma = np.ones(3), np.array([5.0, 1e9, 0.5]), np.full(3, 100.0)
    flat = np.maximum(out / (skin.LENGTH * np.maximum(sigma, 1e-6)), 1 / skin.FLATTEST) ** 2
    actual = skin.squared_horizon(ops, out, along, sigma)
    np.testing.assert_allclose(actual, [0.04 - flat[0], 0, 1 - flat[2]])
    depths = np.array([0.5, 3.5, 5.0, 20.0])
    np.testing.assert_allclose(
        skin.softness(ops, 0.1, 1.0, depths), 0.1 * skin.CHAPMAN * np.array([0, 0.5, 1, 1]), rtol=1e-12
    )
