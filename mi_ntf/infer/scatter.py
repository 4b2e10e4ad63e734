"""Importance sampling of the field's phase function: directions to the light, for a viewer (field coordinates).

Three densities over the side that the normal faces, with c = ⟨n,ω_o⟩⁺: cosine and uniform, which together follow the
diffuse lobe of a flat skin, ∝ ⟨n,ω_i⟩ + c, exactly, and the half vector of the specular lobe.
"""

import drjit as dr

from ..core import fresnel, microfacet
from ..core.ops import cross, dot, normalize
from . import ops
from .shade import Reflectance
from .types import Float, Vector


def evaluate(wi: Vector, wo: Vector, reflectance: Reflectance) -> tuple[Vector, Float]:
    """Return ``(value, pdf)`` of light scattered from `wi` to `wo`, both 0 for a viewer below the horizon.

    The value is the phase function (linear RGB, 1/sr), the density that of :func:`sample` (1/sr).
    """
    normal, albedo, roughness, specular, softness, retro, tail, lobe, _ = reflectance
    if lobe:
        phase, pdf = lobe.evaluate(wi, wo)
        return tuple(k * c for k, c in zip(albedo, phase, strict=True)), pdf
    diffuse, glossy = microfacet.scattering(ops, wi, wo, normal, roughness, softness, tail)
    weights = [fresnel.weights(ops, wi, wo, normal, roughness, s, retro) for s in specular]
    value = tuple(k * w * diffuse + s * glossy for k, (w, s) in zip(albedo, weights, strict=True))
    half = normalize(ops, tuple(a + b for a, b in zip(wi, wo, strict=True)))
    cos_h = dr.maximum(dot(normal, half), 0)
    across = cross(normal, half)
    jacobian = dr.rcp(4 * dr.maximum(dot(wo, half), 1e-6))
    pdf_specular = microfacet.distribution(ops, dot(across, across), roughness * roughness, tail) * cos_h * jacobian
    chance, above = _specular_chance(wo, reflectance)
    flat = (dot(normal, wi) + above) * microfacet.INV_PI
    pdf = (1 - chance) * flat / (1 + 2 * above) + chance * pdf_specular
    # Half vectors can mirror to below the surface. Such samples are void.
    return value, dr.select(diffuse > 0, pdf, 0)


def sample(wo: Vector, reflectance: Reflectance, u1: Float, u2: tuple[Float, Float]) -> Vector:
    """Return a unit direction to the light, of the density of :func:`evaluate`; `u1`, `u2`: uniform in [0, 1)."""
    if reflectance.lobe:
        return reflectance.lobe.sample(wo, u1, u2)
    normal, roughness = reflectance.normal, reflectance.roughness
    chance, above = _specular_chance(wo, reflectance)
    glossy = u1 < chance
    uniform = (u1 - chance) * (1 + 2 * above) > 1 - chance
    phi = 2 * dr.pi * u2[1]
    cos_specular = microfacet.sample_cosine(ops, u2[0], roughness * roughness, reflectance.tail)
    cos = dr.select(glossy, cos_specular, dr.select(uniform, u2[0], dr.sqrt(1 - u2[0])))
    sin = dr.safe_sqrt(1 - cos * cos)
    s, t = tangents(normal)
    m = tuple(sin * dr.cos(phi) * a + sin * dr.sin(phi) * b + cos * c for a, b, c in zip(s, t, normal, strict=True))
    twice = 2 * dot(wo, m)
    wi = tuple(dr.select(glossy, twice * a - b, a) for a, b in zip(m, wo, strict=True))
    return normalize(ops, wi)


def _specular_chance(wo: Vector, reflectance: Reflectance) -> tuple[Float, Float]:
    """Return the probability of the specular lobe, and ⟨n,ω_o⟩⁺.

    The probability is the lobe's fraction of the albedo within [0.1, 0.9], and 0 seen from behind.
    """
    normal, albedo, specular = reflectance.normal, reflectance.albedo, reflectance.specular
    above = dr.maximum(dot(normal, wo), 0)
    diffuse = sum((1 - s) * k for s, k in zip(specular, albedo, strict=True))
    gloss = sum(specular)
    chance = dr.clip(gloss / dr.maximum(gloss + diffuse, 1e-6), 0.1, 0.9)
    return dr.select(above > 0, chance, 0), above


def tangents(n: Vector) -> tuple[Vector, Vector]:
    """Return two unit vectors perpendicular to `n` and each other (Duff et al. 2017)."""
    sign = dr.select(n[2] < 0, -1, 1)
    a = -dr.rcp(sign + n[2])
    b = n[0] * n[1] * a
    return (1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])
