"""Fresnel's effect: more glossy light at grazing angles, and as much less diffuse light (Schlick 1994).

    F = s + (1 − s) (1 − ⟨ω_o,h⟩)⁵

in place of the specular weight s, which is the reflectance at normal incidence: DIELECTRIC at least, more where metal
shows. Photographs with the light at the camera see the half vector h along the view, so F = s there; what real
materials make of it elsewhere follows. That no smooth surface reflects less than a dielectric is known beforehand,
since highlights of 0.04 are too faint to be told from the errors of normals. What is rough has the same s, and a lobe
that hardly shows. The light of the rim the diffuse lobe lacks, on its way in and out alike (Kelemen and Szirmay-Kalos
2001; Ashikhmin and Shirley 2000): it counts

    (1 − s) (1 − R(⟨n,ω_i⟩)) (1 − R(⟨n,ω_o⟩)) / (1 − R̄)

with R(c; α) what a GGX lobe of weight (1 − ⟨ω_o,h⟩)⁵ reflects of light from everywhere, and R̄ its cosine-weighted
mean. So ρ stays reciprocal, and its directional albedo at most (1 − s)(1 − R) k + s + (1 − s) R ≤ 1. Fields whose
``Architecture.fresnel`` is false have lobes of the fixed weights 1 − s and s.
"""

from .microfacet import diffuse_albedo as without_rim
from .ops import dot

DIELECTRIC = 0.04
"""Normal reflectance of a dielectric of index 1.5; of most, 0.02 to 0.05."""


def weights(ops, wi, wo, n, roughness, specular, rim: bool):
    """What the lobes of :mod:`mi_ntf.core.microfacet` count, ``(diffuse, specular)``: ρ = diffuse weight · k · diffuse
    lobe + specular weight · specular lobe. Directions as there. `rim`: whether there is a Fresnel term."""
    if not rim:
        return 1 - specular, specular
    # ⟨ω_o,h⟩² = (1 + ⟨ω_i,ω_o⟩)/2; of opposite directions rounding makes less than 0.
    cos_h = ops.sqrt(ops.maximum(0.5 + 0.5 * dot(wi, wo), 1e-12))
    away = ops.maximum(1 - cos_h, 0.0)
    square = away * away
    grazing, mean = _rim(ops, roughness)
    cos_i, cos_o = (ops.maximum(dot(n, w), 0.0) for w in (wi, wo))
    left = (1 - grazing(cos_i)) * (1 - grazing(cos_o)) / (1 - mean)
    return (1 - specular) * left, specular + (1 - specular) * square * square * away


def weights_collocated(ops, cos, roughness, specular, rim: bool):
    """:func:`weights` for light and viewer in one direction at cosine `cos` to the normal."""
    if not rim:
        return 1 - specular, specular
    grazing, mean = _rim(ops, roughness)
    once = 1 - grazing(ops.maximum(cos, 0.0))
    return (1 - specular) * once * once / (1 - mean), specular


def diffuse_albedo(ops, albedo, roughness, specular, rim: bool):
    """As :func:`mi_ntf.core.microfacet.diffuse_albedo`, with the rim's light where there is a `rim`."""
    fixed = without_rim(albedo, roughness, specular)
    if not rim:
        return fixed
    _, mean = _rim(ops, roughness)
    return fixed + (1 - specular) * mean * (1 - albedo)


def _rim(ops, roughness):
    """``(R, R̄)``: R a function of the cosine.

    R is b (1 − c)^q, a fit to quadrature: within 0.02 from α = 0.2 on; below within 0.06, and 0.1 at c < 0.04.
    """
    alpha = roughness * roughness
    b = 1 / (1 + alpha * (9 + alpha * (51 - 21 * alpha)))
    q = 2.65 + 1.9 * ops.exp(-11 * alpha)

    def grazing(cos):
        return b * ops.exp(q * ops.log(ops.maximum(1 - cos, 1e-6)))

    return grazing, 2 * b / ((q + 1) * (q + 2))
