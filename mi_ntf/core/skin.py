"""How soft a skin is: what its thickness and curvature let grazing light do.

In a flat skin the optical depth to the outside is that along the normal over ⟨n,ω⟩, and light along the skin never gets
out. A curved one falls away from a ray: at the horizon its depth is the normal's over c₀ > 0, in an exponential skin of
scale height δ on a sphere of radius R over √(2δ/πR) (Chapman 1931). :func:`mi_ntf.core.microfacet.scattering` goes by
the softness, CHAPMAN · c₀², measured in the field itself: by marches from the voxels of its skins, outwards, inwards
and along the skin.
"""

import math

from .ops import cross, normalize

CHAPMAN = 5.3
"""Softness over c₀²: the depth of an exponential skin within 3 % from ⟨n,ω⟩ = c₀ on."""
AZIMUTHS = 8
LENGTH = 0.5
"""How far along the skin its curvature counts, in unit-sphere radii."""
DEEPEST = 12.0
"""Points below that optical depth see neither camera nor light."""
FLATTEST = 40.0
"""Depths along the skin, relative to the normal's, above which it counts as flat."""
SMOKE, SOLID = 3.0, 6.0
"""Optical depths across: what has less than the first has no skin, what has more than the second is opaque."""


TURNS = tuple((math.cos(2 * math.pi * k / AZIMUTHS), math.sin(2 * math.pi * k / AZIMUTHS)) for k in range(AZIMUTHS))
"""Cosine and sine of the azimuths."""


def across(ops, normal, turn):
    """The unit direction perpendicular to the unit 3-tuple `normal` at the azimuth `turn`, a pair of TURNS."""
    steep = ops.abs(normal[0]) > 0.7
    zero, one = 0 * normal[0], 0 * normal[0] + 1
    side = ops.where(steep, zero, one), ops.where(steep, one, zero), zero
    u = normalize(ops, cross(normal, side))
    v = cross(normal, u)
    return tuple(turn[0] * a + turn[1] * b for a, b in zip(u, v, strict=True))


def share(ops, out, along, sigma):
    """c₀² by one direction along the skin: `out`, `along`: optical depths from a point along its normal and there;
    `sigma`: density at the point. 0 for what is as flat as it can look within LENGTH and FLATTEST."""
    flat = ops.maximum(out / (LENGTH * ops.maximum(sigma, 1e-6)), 1 / FLATTEST)
    c = out / ops.maximum(along, out)
    return ops.maximum(c * c - flat * flat, 0.0)


def softness(ops, shares, out, below):
    """Of the mean `shares`; `below`: optical depth inwards. Smoke has no skin, and softness 0."""
    solid = (out + below - SMOKE) * (1 / (SOLID - SMOKE))
    return CHAPMAN * shares * ops.minimum(ops.maximum(solid, 0.0), 1.0)
