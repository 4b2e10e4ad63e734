"""Fresnel's effect: fit against quadrature, energy, reciprocity, collocated light, a dielectric, retro-reflection."""

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


def _rho(wi, wo, k, s, roughness, retro):
    """ρ ⟨n,ω_i⟩."""
    diffuse, gloss = microfacet.lobes(ops, wi, wo, N, roughness)
    of_diffuse, of_gloss = fresnel.weights(ops, wi, wo, N, roughness, s, retro)
    return of_diffuse * k * diffuse + of_gloss * gloss


def _dielectric(cos):
    """Fresnel's equations for unpolarised light at the cosine `cos`, of index 1.5."""
    inside = np.sqrt(1 - (1 - cos**2) / 1.5**2)
    s = ((cos - 1.5 * inside) / (cos + 1.5 * inside)) ** 2
    p = ((1.5 * cos - inside) / (1.5 * cos + inside)) ** 2
    return (s + p) / 2


@cache
def _reflected(cos, roughness, n=400):
    """``(A, R)``: what a GGX lobe of weight 1 and one of φ(⟨ω_o,h⟩) reflect of uniform light, by half vectors
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
    return weight.mean(), (weight * (_dielectric(np.clip(oh, 0, 1)) - 0.04) / 0.96).mean()


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_rim_reflectance_agrees_with_quadrature(roughness):
    """The fits of R and of its mean R̄ agree with quadrature."""
    grazing, mean = fresnel._rim(ops, roughness)
    for cos in (0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0):
        error = 0.01 if cos >= 0.1 else 0.06 if cos > 0.04 else 0.08  # as the docstring says of the fit
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
        of_diffuse, _ = fresnel.weights(ops, wi, wo, N, roughness, s, 0.0)
        diffuse = np.pi * np.einsum("i,j,ij->", w / 2, w, of_diffuse * wi[2]) / np.pi
        whole, rim = _reflected(cos, roughness)
        assert diffuse + s * whole + (1 - s) * rim <= 1.012


@given(above, above, st.floats(0, 1), st.floats(0, 1), st.floats(0.15, 1), st.floats(0, 1))
def test_reciprocity(wi, wo, k, s, roughness, retro):
    forward, backward = (_rho(a, b, k, s, roughness, retro) / a[2] for a, b in ((wi, wo), (wo, wi)))
    assert forward == pytest.approx(backward, rel=1e-9) and forward >= 0


@given(above, st.floats(0, 1), st.floats(0.15, 1), st.floats(0, 1))
def test_light_at_the_camera(w, s, roughness, retro):
    """Photographs see the normal reflectance."""
    general = fresnel.weights(ops, w, w, N, roughness, s, retro)
    assert fresnel.weights_collocated(ops, w[2], roughness, s, retro) == pytest.approx(general, rel=1e-9, abs=1e-12)
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


def test_the_specular_weight_is_that_of_a_dielectric():
    """Index 1.5, reflectance DIELECTRIC: Fresnel's equations at all angles."""
    assert pytest.approx(0.04) == fresnel.DIELECTRIC
    for cos_h in np.linspace(0.05, 1, 20):
        wo, wi = _direction(cos_h, 0.0), _direction(cos_h, np.pi)
        half = normalize(ops, tuple(a + b for a, b in zip(wi, wo, strict=True)))
        assert dot(half, wo) == pytest.approx(cos_h)
        assert fresnel.weights(ops, wi, wo, N, 0.3, fresnel.DIELECTRIC, 0.0)[1] == pytest.approx(_dielectric(cos_h))


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_retro_reflection_keeps_the_albedo(roughness):
    """The mean of the diffuse weight over both directions is that without it: the normalisation is of first order."""
    t, w = np.polynomial.legendre.leggauss(32)
    cos, weight = (t + 1) / 2, w * (t + 1) / 2  # of ∫ 2c dc
    phi = np.pi * (np.arange(16) + 0.5) / 16
    wi, wo = _direction(cos[:, None, None], phi), _direction(cos[None, :, None], 0.0)
    wi, wo = ([c + 0 * phi + 0 * cos[:, None, None] + 0 * cos[None, :, None] for c in v] for v in (wi, wo))
    mean = [np.einsum("i,j,ijk->", weight, weight, fresnel.weights(ops, wi, wo, N, roughness, 0.04, retro)[0]) / 16
            for retro in (0.0, 1.0)]
    assert mean[1] == pytest.approx(mean[0], rel=0.003)


def test_retro_reflection_is_that_of_burley():
    """Against the formula of Burley 2012, section 5.3, as written there: F_D90 − 1 in terms of R_R."""
    wi, wo, roughness = _direction(0.2, 0.4), _direction(0.3, 0.0), 0.7
    none, full = (fresnel.weights(ops, wi, wo, N, roughness, 0.04, retro)[0] for retro in (0.0, 1.0))
    half = normalize(ops, tuple(a + b for a, b in zip(wi, wo, strict=True)))
    r = 2 * roughness * dot(half, wi) ** 2
    f_i, f_o = 0.8**5, 0.7**5
    _, mean = fresnel._rim(ops, roughness)
    expected = none + 0.96 * (1 - mean) * r * (f_i + f_o + f_i * f_o * (r - 1))
    assert full * (1 + roughness / 9) == pytest.approx(expected)
