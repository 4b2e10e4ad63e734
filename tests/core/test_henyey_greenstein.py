"""The phase function of Henyey and Greenstein in float64: its integral, its mean cosine, and its inverse."""

import numpy as np
import pytest

from mi_ntf.core import henyey_greenstein, ops

G = [-0.95, -0.4, -1e-9, 0.0, 1e-6, 0.3, 0.9]


@pytest.mark.parametrize("g", G)
def test_its_integral_is_one_and_its_mean_cosine_the_asymmetry(g):
    """Both are quadratures over the sphere, by 400 Gauss-Legendre nodes in the cosine."""
    cos, weight = np.polynomial.legendre.leggauss(400)
    value = 2 * np.pi * weight * henyey_greenstein.phase(ops, g, cos)
    assert value.sum() == pytest.approx(1, rel=1e-9)
    assert (cos * value).sum() == pytest.approx(g, abs=1e-9)


@pytest.mark.parametrize("g", G)
def test_deflections_have_the_fraction_of_light_below_them(g):
    """The fraction of light that is deflected to less than a cosine c is (1 − g²)/(2g) (1/√(1 + g² − 2gc) − 1/(1 + g)).

    For a small g, whose fraction loses its digits in this form, it is (1 + c)/2 + g (c² − 1) 3/4.
    """
    u = np.linspace(0, 1, 101)
    c = henyey_greenstein.deflection(g, u)
    if abs(g) < 1e-3:
        below = (1 + c) / 2 + 0.75 * g * (c * c - 1)
    else:
        below = (1 - g * g) / (2 * g) * (1 / np.sqrt(1 + g * g - 2 * g * c) - 1 / (1 + g))
    np.testing.assert_allclose(below, u, atol=1e-11)
    assert c[0] == pytest.approx(-1, abs=1e-12) and c[-1] == pytest.approx(1, abs=1e-12)
