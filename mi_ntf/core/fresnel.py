"""Fresnel's effect: more specular light at grazing angles, and as much less diffuse light.

    F = s + (1 − s) φ(⟨ω_o,h⟩),        φ(c) = (F₁.₅(c) − F₁.₅(1)) / (1 − F₁.₅(1))

replaces the specular weight s, which is the reflectance at normal incidence: at least DIELECTRIC, more for metal. F₁.₅
are Fresnel's equations for a dielectric of index 1.5. Schlick's (1 − c)⁵ in place of φ lacks a sixth of a dielectric's
reflectance at 45°, and under wide lights most half vectors are that far from the viewer. In
photographs with the light at the camera the half vector h lies along the view, so F = s there, and the formula extends
it to other angles. Metals have another s in each channel of linear RGB, and hardly a diffuse part. All formulas hold
for each channel alone. The bound holds because no smooth surface reflects less than a dielectric, although highlights
of 0.04 are too faint to be separated from errors of normals. Rough surfaces have the same s, with a hardly visible
lobe.
The diffuse lobe lacks the light of the rim, on its way in and out alike (Kelemen and Szirmay-Kalos 2001; Ashikhmin and
Shirley 2000). Its weight is

    (1 − s) [(1 − R(c_i)) (1 − R(c_o)) / (1 − R̄) + (1 − R̄) ϱ E(ω_i, ω_o)] / (1 + ϱ r/9)

with c_i = ⟨n,ω_i⟩, c_o = ⟨n,ω_o⟩, R(c; α) the reflectance of a GGX lobe of weight φ(⟨ω_o,h⟩) under uniform light, and
R̄ its cosine-weighted mean. ϱ in [0, 1] is the retro-reflection of a field, one number for all of its points: rough
diffuse surfaces send more light back to where it came from at grazing angles (Burley 2012, section 5.3, whose

    E = e (f_i + f_o + f_i f_o (e − 1)),        e = 2 r ⟨ω_o,h⟩²,        f = (1 − c)⁵,        r: roughness,

is that of Mitsuba's ``principled``). Photographs with a flash see all of it, and other lights little; without ϱ they
were explained by a rougher specular lobe. E has the cosine-weighted mean r/9 to first order in f, so k stays the albedo
under uniform light. ρ is reciprocal. Without retro-reflection its directional albedo is at most
(1 − s)(1 − R) k + s + (1 − s) R ≤ 1; with it, a white surface may send out more than comes in at grazing angles, as
Burley's does. Fields whose ``Architecture.fresnel`` is False have lobes of the fixed weights 1 − s and s.
"""

from collections.abc import Callable

from .microfacet import diffuse_albedo as without_rim
from .ops import Array, Ops, Vector, dot

INDEX = 1.5
"""Index of refraction of glass and of most paints and plastics."""
DIELECTRIC = ((INDEX - 1) / (INDEX + 1)) ** 2
"""Normal reflectance of such a dielectric, 0.04; most have 0.02 to 0.05."""


def weights(ops: Ops, wi: Vector, wo: Vector, n: Vector, roughness: Array, specular: Array,
            retro: Array | None) -> tuple[Array, Array]:
    """Return the weights ``(diffuse, specular)`` of the lobes of :mod:`mi_ntf.core.microfacet`.

    ρ = diffuse weight · k · diffuse lobe + specular weight · specular lobe. Directions as there. `retro`: ϱ, or None
    without a Fresnel term.
    """
    if retro is None:
        return 1 - specular, specular
    # ⟨ω_o,h⟩² = (1 + ⟨ω_i,ω_o⟩)/2, which rounding can make negative for opposite directions.
    cos2_h = ops.minimum(ops.maximum(0.5 + 0.5 * dot(wi, wo), 1e-12), 1.0)
    cos_i, cos_o = (ops.maximum(dot(n, w), 0.0) for w in (wi, wo))
    return (_diffuse(ops, cos_i, cos_o, cos2_h, roughness, specular, retro),
            specular + (1 - specular) * _growth(ops, cos2_h))


def weights_collocated(ops: Ops, cos: Array, roughness: Array, specular: Array,
                       retro: Array | None) -> tuple[Array, Array]:
    """Return :func:`weights` for light and viewer in one direction at cosine `cos` to the normal."""
    if retro is None:
        return 1 - specular, specular
    c = ops.maximum(cos, 0.0)
    return _diffuse(ops, c, c, 1.0, roughness, specular, retro), specular


def diffuse_albedo(ops: Ops, albedo: Array, roughness: Array, specular: Array, rim: bool) -> Array:
    """Return :func:`mi_ntf.core.microfacet.diffuse_albedo`, plus the rim's light where there is a `rim`."""
    fixed = without_rim(albedo, roughness, specular)
    if not rim:
        return fixed
    _, mean = _rim(ops, roughness)
    return fixed + (1 - specular) * mean * (1 - albedo)


def _growth(ops: Ops, cos2: Array) -> Array:
    """Return φ of a squared cosine."""
    c = ops.sqrt(cos2)
    g = ops.sqrt(INDEX * INDEX - 1 + cos2)
    ratio, other = (g - c) / (g + c), (c * (g + c) - 1) / (c * (g - c) + 1)
    return (0.5 * ratio * ratio * (1 + other * other) - DIELECTRIC) / (1 - DIELECTRIC)


def _diffuse(ops: Ops, cos_i: Array, cos_o: Array, cos2_h: Array, roughness: Array, specular: Array,
             retro: Array) -> Array:
    """Return the weight of the diffuse lobe for the cosines ⟨n,ω_i⟩⁺, ⟨n,ω_o⟩⁺ and ⟨ω_o,h⟩²."""
    grazing, mean = _rim(ops, roughness)
    transmitted = (1 - grazing(cos_i)) * (1 - grazing(cos_o)) / (1 - mean)
    back = 2 * roughness * cos2_h
    f_i, f_o = _fifth(1 - cos_i), _fifth(1 - cos_o)
    retro_reflected = back * (f_i + f_o + f_i * f_o * (back - 1))
    return (1 - specular) * (transmitted + (1 - mean) * retro * retro_reflected) / (1 + retro * roughness * (1 / 9))


def _fifth(x: Array) -> Array:
    square = x * x
    return square * square * x


def _rim(ops: Ops, roughness: Array) -> tuple[Callable[[Array], Array], Array]:
    """Return ``(R, R̄)``, R as a function of the cosine.

    R is b (1 − c)^q, a fit to quadrature: within 0.01 at c ≥ 0.1, 0.06 at c ≥ 0.05, and 0.08 below.
    """
    alpha = roughness * roughness
    b = 1 / (1 + alpha * (13 + alpha * (26.4 - 5.3 * alpha)))
    q = 2.27 + 2.45 * ops.exp(-14.2 * alpha)

    def grazing(cos: Array) -> Array:
        return b * ops.exp(q * ops.log(ops.maximum(1 - cos, 1e-6)))

    return grazing, 2 * b / ((q + 1) * (q + 2))
