"""Fresnel's effect: more specular light at grazing angles, and as much less diffuse light (Schlick 1994).

    F = s + (1 − s) (1 − ⟨ω_o,h⟩)⁵

replaces the specular weight s, which is the reflectance at normal incidence: at least DIELECTRIC, more for metal. In
photographs with the light at the camera the half vector h lies along the view, so F = s there, and the formula extends
it to other angles. Metals have another s in each channel of linear RGB, and hardly a diffuse part. All formulas hold
for each channel alone. The bound holds because no smooth surface reflects less than a dielectric, although highlights
of 0.04 are too faint to be separated from errors of normals. Rough surfaces have the same s, with a hardly visible
lobe.
The diffuse lobe lacks the light of the rim, on its way in and out alike (Kelemen and Szirmay-Kalos 2001; Ashikhmin and
Shirley 2000). Its weight is

    (1 − s) (1 − R(⟨n,ω_i⟩)) (1 − R(⟨n,ω_o⟩)) / (1 − R̄)

with R(c; α) the reflectance of a GGX lobe of weight (1 − ⟨ω_o,h⟩)⁵ under uniform light, and R̄ its cosine-weighted
mean. So ρ stays reciprocal, and its directional albedo at most (1 − s)(1 − R) k + s + (1 − s) R ≤ 1. Fields whose
``Architecture.fresnel`` is False have lobes of the fixed weights 1 − s and s.
"""

from collections.abc import Callable

from .microfacet import diffuse_albedo as without_rim
from .ops import Array, Ops, Vector, dot

DIELECTRIC = 0.04
"""Normal reflectance of a dielectric of index 1.5; most have 0.02 to 0.05."""


def weights(ops: Ops, wi: Vector, wo: Vector, n: Vector, roughness: Array, specular: Array,
            rim: bool) -> tuple[Array, Array]:
    """Return the weights ``(diffuse, specular)`` of the lobes of :mod:`mi_ntf.core.microfacet`.

    ρ = diffuse weight · k · diffuse lobe + specular weight · specular lobe. Directions as there. `rim`: there is a
    Fresnel term.
    """
    if not rim:
        return 1 - specular, specular
    # ⟨ω_o,h⟩² = (1 + ⟨ω_i,ω_o⟩)/2, which rounding can make negative for opposite directions.
    cos_h = ops.sqrt(ops.maximum(0.5 + 0.5 * dot(wi, wo), 1e-12))
    complement = ops.maximum(1 - cos_h, 0.0)
    square = complement * complement
    grazing, mean = _rim(ops, roughness)
    cos_i, cos_o = (ops.maximum(dot(n, w), 0.0) for w in (wi, wo))
    transmitted = (1 - grazing(cos_i)) * (1 - grazing(cos_o)) / (1 - mean)
    return (1 - specular) * transmitted, specular + (1 - specular) * square * square * complement


def weights_collocated(ops: Ops, cos: Array, roughness: Array, specular: Array, rim: bool) -> tuple[Array, Array]:
    """Return :func:`weights` for light and viewer in one direction at cosine `cos` to the normal."""
    if not rim:
        return 1 - specular, specular
    grazing, mean = _rim(ops, roughness)
    once = 1 - grazing(ops.maximum(cos, 0.0))
    return (1 - specular) * once * once / (1 - mean), specular


def diffuse_albedo(ops: Ops, albedo: Array, roughness: Array, specular: Array, rim: bool) -> Array:
    """Return :func:`mi_ntf.core.microfacet.diffuse_albedo`, plus the rim's light where there is a `rim`."""
    fixed = without_rim(albedo, roughness, specular)
    if not rim:
        return fixed
    _, mean = _rim(ops, roughness)
    return fixed + (1 - specular) * mean * (1 - albedo)


def _rim(ops: Ops, roughness: Array) -> tuple[Callable[[Array], Array], Array]:
    """Return ``(R, R̄)``, R as a function of the cosine.

    R is b (1 − c)^q, a fit to quadrature: within 0.02 from α = 0.2 on; below within 0.06, and 0.1 at c < 0.04.
    """
    alpha = roughness * roughness
    b = 1 / (1 + alpha * (9 + alpha * (51 - 21 * alpha)))
    q = 2.65 + 1.9 * ops.exp(-11 * alpha)

    def grazing(cos: Array) -> Array:
        return b * ops.exp(q * ops.log(ops.maximum(1 - cos, 1e-6)))

    return grazing, 2 * b / ((q + 1) * (q + 2))
