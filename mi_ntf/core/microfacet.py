"""The field's reflectance: Lambert plus microfacets (Walter et al. 2007, eqs. 33, 34, 20).

    ρ = (1 − s) k/π + s D(h; α) G1(ω_i) G1(ω_o) / (4 ⟨n,ω_i⟩ ⟨n,ω_o⟩),        α = roughness²

k: diffuse albedo (linear RGB, [0, 1]); s: specular weight in [0, 1], of each channel; roughness in [MIN_ROUGHNESS, 1].
It is Mitsuba's ``blendbsdf`` of ``diffuse`` and a GGX ``roughconductor`` with ``material = none``. Fields of real
materials weigh the two lobes by :mod:`mi_ntf.core.fresnel` instead of 1 − s and s.

D is GGX for fields without a tail parameter. Fields that learn one, t in [0, 1], have the distribution of Student

    D = (1 + t x)^(−1−1/t) / (π α² cos⁴θ),        x = tan²θ/α²

(Ribardière et al. 2017, with γ = 1 + 1/t), which is GGX at t = 1 and Beckmann's in the limit t → 0: Mitsuba's two
distributions, and all between. Its G1 lies between those of both, by the weight t (1 + t)/2 of GGX, within 0.011 of
Smith's integral.

ω_i points to the light, ω_o to the viewer, n is the normal: unit 3-vectors. The diffuse lobe needs only ⟨n,ω_i⟩ > 0;
the specular lobe also needs ⟨n,ω_o⟩ > 0. So ρ is reciprocal where both are positive, and the directional albedo
∫ ρ ⟨n,ω_i⟩ dω_i is at most (1 − s) k + s ≤ 1 everywhere. As a volume, the field scatters with :func:`scattering`, which
makes an opaque skin reflect like a surface of this ρ.
"""

import math

from .ops import Array, Ops, Vector, cross, dot, normalize

MIN_ROUGHNESS = 0.15
MIN_TAIL = 0.01
"""Least tail that formulas take, since they divide by it. D then differs from Beckmann's by 1 % where it is a tenth of
its peak."""
INV_PI = 1 / math.pi
BECKMANN_FREE = 1.6
"""cot(θ)/α from which Beckmann's microfacets hide nothing of each other, in Walter's fit."""
HORIZON = 1e-8
"""Largest cosine at which a direction counts as one along the surface. Derivatives divide by its square, which float32
cannot hold for smaller ones."""


def ggx(sin2_h: Array, alpha: Array) -> Array:
    """Return the density D(h) of GGX's normals; `sin2_h` = 1 − ⟨n,h⟩² with ⟨n,h⟩ ≥ 0, `alpha` = roughness².

    The sine, not the cosine: at α = 0.02 the rounding of a float32 cosine near 1 moves the peak of D by 5e-4.
    """
    a2 = alpha * alpha
    k = a2 + (1 - a2) * sin2_h
    return a2 / (math.pi * k * k)


def distribution(ops: Ops, sin2_h: Array, alpha: Array, tail: Array | None) -> Array:
    """Return D(h) of a lobe of this tail, GGX without one; otherwise as :func:`ggx`."""
    if tail is None:
        return ggx(sin2_h, alpha)
    t, a2 = ops.maximum(tail, MIN_TAIL), alpha * alpha
    level = a2 * (1 - sin2_h)
    k = level + t * sin2_h
    return a2 / (math.pi * k * k) * ops.exp((1 - t) / t * ops.log(ops.maximum(level / k, 1e-30)))


def sample_cosine(ops: Ops, u: Array, alpha: Array, tail: Array | None) -> Array:
    """Return ⟨n,h⟩ of the density D(h) ⟨n,h⟩ of :func:`distribution`, for uniform numbers `u` in [0, 1)."""
    if tail is None:
        return ops.sqrt((1 - u) / (1 + (alpha * alpha - 1) * u))  # Walter et al. 2007, eq. 35
    t = ops.maximum(tail, MIN_TAIL)
    x = (ops.exp(-t * ops.log(ops.maximum(1 - u, 1e-7))) - 1) / t
    return 1 / ops.sqrt(1 + alpha * alpha * x)


def smith(ops: Ops, cos: Array, alpha: Array, tail: Array | None = None) -> Array:
    """Return G1(ω)/(2⟨n,ω⟩) for ⟨n,ω⟩ = `cos` ≥ 0; G1 is the visible fraction of the microfacets.

    The quotient is finite at grazing directions, where both terms vanish. G1 of Beckmann's distribution is the rational
    fit that Mitsuba has too (Walter et al. 2007, section 5.3), within 0.003.
    """
    a2 = alpha * alpha
    wide = 1 / (cos + ops.sqrt(a2 + (1 - a2) * cos * cos))
    if tail is None:
        return wide
    across = alpha * ops.sqrt(ops.maximum(1 - cos * cos, 1e-12))
    a = ops.minimum(cos / across, BECKMANN_FREE)
    narrow = (3.535 + 2.181 * a) / ((1 + a * (2.276 + 2.577 * a)) * 2 * ops.maximum(across, cos * (1 / BECKMANN_FREE)))
    return narrow + 0.5 * tail * (1 + tail) * (wide - narrow)


def lobes(ops: Ops, wi: Vector, wo: Vector, n: Vector, roughness: Array, tail: Array | None = None
          ) -> tuple[Array, Array]:
    """Return the two lobes times the light's cosine: ``(diffuse, specular)``, scalars, 1/sr.

    ρ·⟨n,ω_i⟩⁺ = (1 − s)·k·diffuse + s·specular. Colour enters outside, once for any number of channels.
    """
    cos_i, _, specular = _cosines(ops, wi, wo, n, roughness, tail)
    return cos_i * INV_PI, specular * cos_i


def scattering(ops: Ops, wi: Vector, wo: Vector, n: Vector, roughness: Array,
               softness: Array = 0.0, tail: Array | None = None) -> tuple[Array, Array]:
    """Return the two lobes of the field's phase function f; otherwise as :func:`lobes`.

    f = ρ (c_i + c_o) min(⟨n,ω_i⟩/c_i, ⟨n,ω_o⟩/c_o), 0 unless both cosines are positive.

    c = (⟨n,ω⟩ + √(⟨n,ω⟩² + `softness` (1 − ⟨n,ω⟩²)))/2 is ⟨n,ω⟩ in a flat skin, of softness 0, and more at grazing
    angles of a curved one (:mod:`mi_ntf.core.skin`): the optical depth to the outside is that along the normal over c.

    The sum: a half space of any density profile that scatters once with f returns f c_i/(c_i + c_o) (Lommel and
    Seeliger; Chandrasekhar 1960, section 6), because the light too is dimmed on its way through the skin to the
    scattering point. With this f that is ρ ⟨n,ω_i⟩: an opaque field looks like the surface, from all sides and under
    all lights. With the paper's ρ ⟨n,ω_i⟩ alone it would lose half of the light and fade towards grazing light.

    The minimum: f is c_i ρ ⟨n,ω_o⟩/c_o where light falls in more steeply than the viewer looks. A curved skin is wider
    than the surface at grazing angles of view, so it must send less there for f to be reciprocal over the whole sphere,
    as a phase function has to be. A white field then never sends out more than comes in. With ⟨n,ω_i⟩ + ⟨n,ω_o⟩ a
    white sphere whose skin is 1/25 of its radius thick shines 1.08 in a white furnace. Light and viewer in one
    direction see ρ ⟨n,ω⟩ exactly.

    No light is scattered to below the horizon: it would scatter again in the skin that it has just left, and every
    further bounce would add energy that the surface does not have.
    """
    cos_i, cos_o, specular = _cosines(ops, wi, wo, n, roughness, tail)
    joint = joint_cosine(ops, cos_i, cos_o, softness)
    return joint * INV_PI, specular * joint


def joint_cosine(ops: Ops, cos_i: Array, cos_o: Array, softness: Array) -> Array:
    """Return (c_i + c_o) min(⟨n,ω_i⟩/c_i, ⟨n,ω_o⟩/c_o), see :func:`scattering`; 0 unless both cosines exceed HORIZON.

    ⟨n,ω⟩/c grows with ⟨n,ω⟩, so the minimum is that of the smaller cosine. As 2/(1 + √(1 + `softness` tan²)) it is
    exactly 1 in flat skins and its derivative exactly 0; the quotient's loses its digits at grazing angles.
    """
    smaller = ops.minimum(cos_i, cos_o)
    tan2 = (1 - smaller * smaller) / ops.maximum(smaller * smaller, HORIZON**2)
    ratio = 2 / (1 + ops.sqrt(1 + softness * tan2))
    joint = (soft_cosine(ops, cos_i, softness) + soft_cosine(ops, cos_o, softness)) * ratio
    return ops.where(smaller > HORIZON, joint, 0.0 * joint)


def diffuse_albedo(albedo: Array, roughness: Array, specular: Array) -> Array:
    """Return the albedo of a diffuse surface that reflects as much of uniform light as both lobes together.

    `albedo`: of the diffuse lobe. The specular lobe loses light between its microfacets and reflects 1 − 0.267 α −
    1.018 α² + 0.667 α³ (a fit to quadrature, within 0.008).
    """
    a = roughness * roughness
    return (1 - specular) * albedo + specular * (1 - a * (0.267 + a * (1.018 - 0.667 * a)))


def soft_cosine(ops: Ops, cos: Array, softness: Array) -> Array:
    """Return c of :func:`scattering` for ⟨n,ω⟩ = `cos` ≥ 0."""
    return (cos + ops.sqrt(cos * cos + softness * (1 - cos * cos) + 1e-30)) / 2


def _cosines(ops: Ops, wi: Vector, wo: Vector, n: Vector, roughness: Array, tail: Array | None
             ) -> tuple[Array, Array, Array]:
    """Return ⟨n,ω_i⟩⁺, ⟨n,ω_o⟩⁺ and the specular ρ (0 seen from below)."""
    cos_i, cos_o = ops.maximum(dot(n, wi), 0.0), dot(n, wo)
    alpha = roughness * roughness
    above = ops.maximum(cos_o, 0.0)
    half = normalize(ops, tuple(a + b for a, b in zip(wi, wo, strict=True)))
    # ⟨n,h⟩ > 0 wherever the lobe is not zero, so D needs no sign of it.
    across = cross(n, half)
    of_normals = distribution(ops, dot(across, across), alpha, tail)
    specular = of_normals * smith(ops, cos_i, alpha, tail) * smith(ops, above, alpha, tail)
    return cos_i, above, ops.where(cos_o > 0, specular, 0.0 * specular)


def lobes_collocated(ops: Ops, cos: Array, roughness: Array, tail: Array | None = None) -> tuple[Array, Array]:
    """Return :func:`lobes` for light and viewer in one direction, the half vector, at cosine `cos` to the normal."""
    c = ops.maximum(cos, 0.0)
    alpha = roughness * roughness
    g = smith(ops, c, alpha, tail)
    return c * INV_PI, distribution(ops, (1 - c) * (1 + c), alpha, tail) * g * g * c
