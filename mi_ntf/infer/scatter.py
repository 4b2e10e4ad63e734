"""Importance sampling of the field's phase function: directions to the light, given the viewer (field coordinates).

Three densities over the side that the normal faces, with c = ⟨n,ω_o⟩⁺: cosine and uniform, which together follow the
diffuse lobe of a flat skin, ∝ ⟨n,ω_i⟩ + c, exactly, and the GGX half vector (Walter et al. 2007, eqs. 35, 36).
"""

import drjit as dr

from ..core import fresnel, microfacet
from ..core.ops import cross, dot, normalize
from . import ops


def evaluate(wi, wo, reflectance):
    """``(value, pdf)`` of light from `wi` scattered to `wo`: the phase function (3-tuple, 1/sr)
    and the density of :func:`sample`, both 0 for a viewer below the horizon."""
    normal, albedo, roughness, specular, softness, rim = reflectance
    diffuse, gloss = microfacet.scattering(ops, wi, wo, normal, roughness, softness)
    of_diffuse, of_gloss = fresnel.weights(ops, wi, wo, normal, roughness, specular, rim)
    value = tuple(of_diffuse * k * diffuse + of_gloss * gloss for k in albedo)
    half = normalize(ops, tuple(a + b for a, b in zip(wi, wo, strict=True)))
    cos_h = dr.maximum(dot(normal, half), 0)
    across = cross(normal, half)
    jacobian = dr.rcp(4 * dr.maximum(dot(wo, half), 1e-6))
    pdf_gloss = microfacet.ggx(dot(across, across), roughness * roughness) * cos_h * jacobian
    share, above = _gloss_share(wo, reflectance)
    flat = (dot(normal, wi) + above) * microfacet.INV_PI
    pdf = (1 - share) * flat / (1 + 2 * above) + share * pdf_gloss
    # Half vectors can mirror to below the surface. Nothing comes from there: such samples are void.
    return value, dr.select(diffuse > 0, pdf, 0)


def sample(wo, reflectance, u1, u2):
    """A direction to the light. `u1`: scalar, `u2`: pair, uniform in [0, 1). Returns the unit 3-tuple `wi`; its density
    is :func:`evaluate`'s."""
    normal, roughness = reflectance.normal, reflectance.roughness
    share, above = _gloss_share(wo, reflectance)
    gloss = u1 < share
    uniform = (u1 - share) * (1 + 2 * above) > 1 - share
    phi = 2 * dr.pi * u2[1]
    alpha = roughness * roughness
    cos_gloss = dr.sqrt((1 - u2[0]) / (1 + (alpha * alpha - 1) * u2[0]))
    cos = dr.select(gloss, cos_gloss, dr.select(uniform, u2[0], dr.sqrt(1 - u2[0])))
    sin = dr.safe_sqrt(1 - cos * cos)
    s, t = _tangents(normal)
    m = tuple(sin * dr.cos(phi) * a + sin * dr.sin(phi) * b + cos * c for a, b, c in zip(s, t, normal, strict=True))
    twice = 2 * dot(wo, m)
    wi = tuple(dr.select(gloss, twice * a - b, a) for a, b in zip(m, wo, strict=True))
    return normalize(ops, wi)


def _gloss_share(wo, reflectance):
    """Probability of the specular lobe, its share of the albedo within [0.1, 0.9] (0 seen from behind), and
    ⟨n,ω_o⟩⁺."""
    normal, albedo, specular = reflectance.normal, reflectance.albedo, reflectance.specular
    above = dr.maximum(dot(normal, wo), 0)
    diffuse = (1 - specular) * (albedo[0] + albedo[1] + albedo[2]) / 3
    share = dr.clip(specular / dr.maximum(specular + diffuse, 1e-6), 0.1, 0.9)
    return dr.select(above > 0, share, 0), above


def _tangents(n):
    """Two unit vectors perpendicular to `n` and each other (Duff et al. 2017)."""
    sign = dr.select(n[2] < 0, -1, 1)
    a = -dr.rcp(sign + n[2])
    b = n[0] * n[1] * a
    return (1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])
