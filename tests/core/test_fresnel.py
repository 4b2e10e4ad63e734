"""Fresnel's effect: the fit against quadrature, energy, reciprocity, collocated light, and Mitsuba's own dielectric."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_ntf.core import fresnel, microfacet, ops
from mi_ntf.core.ops import dot, normalize

N = (0.0, 0.0, 1.0)
ROUGHNESS = (0.15, 0.3, 0.5, 0.75, 1.0)


def _direction(cos, phi):
    sin = np.sqrt(np.maximum(1 - cos * cos, 0))
    return sin * np.cos(phi), sin * np.sin(phi), cos


above = st.builds(_direction, st.floats(0.02, 1), st.floats(0, 6.3))


def _rho(wi, wo, k, s, roughness):
    """ρ ⟨n,ω_i⟩."""
    diffuse, gloss = microfacet.lobes(ops, wi, wo, N, roughness)
    of_diffuse, of_gloss = fresnel.weights(ops, wi, wo, N, roughness, s, True)
    return of_diffuse * k * diffuse + of_gloss * gloss


@cache
def _reflected(cos, roughness, n=400):
    """``(A, R)``: what a GGX lobe of weight 1 and one of (1 − ⟨ω_o,h⟩)⁵ reflect of uniform light, by half vectors
    drawn from D; no formula of :mod:`mi_ntf.core.fresnel` enters."""
    alpha, u, phi = roughness**2, (np.arange(n) + 0.5) / n, np.pi * (np.arange(n) + 0.5) / n
    c = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))[:, None]
    h = _direction(c, phi[None, :])
    o = _direction(cos, 0.0)
    oh = dot(o, h)
    ci = 2 * oh * h[2] - cos
    ok = (oh > 0) & (ci > 0)
    ci = np.where(ok, ci, 1.0)
    g = 4 * ci * cos * microfacet.smith(ops, ci, alpha) * microfacet.smith(ops, cos, alpha)
    weight = np.where(ok, g * oh / (cos * c), 0)
    return weight.mean(), (weight * (1 - np.clip(oh, 0, 1)) ** 5).mean()


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_rim_reflectance_agrees_with_quadrature(roughness):
    """The fits of R and of its mean R̄ agree with quadrature."""
    grazing, mean = fresnel._rim(ops, roughness)
    for cos in (0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0):
        error = 0.02 if roughness > 0.45 else 0.06 if cos > 0.04 else 0.1  # as the docstring says of the fit
        assert grazing(cos) == pytest.approx(_reflected(cos, roughness)[1], abs=error)
    cosines = (np.arange(400) + 0.5) / 400
    assert mean == pytest.approx(2 * np.mean([grazing(c) * c for c in cosines]), abs=1e-4)


@pytest.mark.parametrize("s", [0.04, 0.3, 1.0])
@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_a_white_surface_never_sends_out_more_than_comes_in(roughness, s):
    """Directional albedo with k = 1: by quadrature of both lobes. 0.012: largest error of the fit of R at
    cosines of 0.1 and more."""
    t, w = np.polynomial.legendre.leggauss(48)
    cos_i, phi = (t + 1) / 2, np.pi * (t + 1)
    wi = _direction(cos_i[:, None], phi[None, :])
    for cos in (0.1, 0.2, 0.4, 0.7, 1.0):
        wo = _direction(cos, 0.0)
        of_diffuse, _ = fresnel.weights(ops, wi, wo, N, roughness, s, True)
        diffuse = np.pi * np.einsum("i,j,ij->", w / 2, w, of_diffuse * wi[2]) / np.pi
        whole, rim = _reflected(cos, roughness)
        assert diffuse + s * whole + (1 - s) * rim <= 1.012


@given(above, above, st.floats(0, 1), st.floats(0, 1), st.floats(0.15, 1))
def test_reciprocity(wi, wo, k, s, roughness):
    forward, backward = (_rho(a, b, k, s, roughness) / a[2] for a, b in ((wi, wo), (wo, wi)))
    assert forward == pytest.approx(backward, rel=1e-9) and forward >= 0


@given(above, st.floats(0, 1), st.floats(0.15, 1))
def test_light_at_the_camera(w, s, roughness):
    """Photographs see the normal reflectance."""
    general = fresnel.weights(ops, w, w, N, roughness, s, True)
    assert fresnel.weights_collocated(ops, w[2], roughness, s, True) == pytest.approx(general, rel=1e-9, abs=1e-12)
    assert general[1] == pytest.approx(s, abs=1e-12)


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize(("k", "s"), [(0.0, 0.04), (0.5, 0.04), (1.0, 0.2), (0.3, 1.0)])
def test_diffuse_albedo_reflects_as_much_of_light_from_everywhere(roughness, k, s):
    cosines = (np.arange(40) + 0.5) / 40
    lobes = np.array([_reflected(c, roughness) for c in cosines])
    gloss, rim = 2 * (cosines[:, None] * lobes).mean(0)
    _, mean = fresnel._rim(ops, roughness)
    expected = (1 - s) * (1 - mean) * k + s * gloss + (1 - s) * rim
    # 0.008 s: the fit of the specular lobe's loss; 0.01: that of the rim's mean.
    assert fresnel.diffuse_albedo(ops, k, roughness, s, True) == pytest.approx(expected, abs=0.008 * s + 0.01)


def test_schlick_is_close_to_a_dielectric():
    """Index 1.5, reflectance DIELECTRIC: Fresnel's equations within 0.04 at all angles (Schlick 1994, figure 3)."""
    for cos_h in np.linspace(0.05, 1, 20):
        wo, wi = _direction(cos_h, 0.0), _direction(cos_h, np.pi)
        half = normalize(ops, tuple(a + b for a, b in zip(wi, wo, strict=True)))
        assert dot(half, wo) == pytest.approx(cos_h)
        inside = np.sqrt(1 - (1 - cos_h**2) / 1.5**2)
        s = ((cos_h - 1.5 * inside) / (cos_h + 1.5 * inside)) ** 2
        p = ((1.5 * cos_h - inside) / (1.5 * cos_h + inside)) ** 2
        assert fresnel.weights(ops, wi, wo, N, 0.3, fresnel.DIELECTRIC, True)[1] == pytest.approx((s + p) / 2, abs=0.04)
