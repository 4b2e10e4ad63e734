"""Softness of a skin: how its thickness and curvature change the scattering of grazing light.

In a flat skin the optical depth to the outside is that along the normal over ⟨n,ω⟩, and light along the skin never gets
out. A curved skin bends away from a ray: at the horizon the depth is the normal's over c₀ > 0. In an exponential skin
of scale height δ on a sphere of radius R it is the normal's over √(2δ/πR) (Chapman 1931). The softness is CHAPMAN · c₀²
(:func:`mi_ntf.core.microfacet.scattering`). It is measured in the field itself by marches from the voxels of its skins:
outwards, inwards and along the skin.
"""

import math

import numpy as np

from .ops import Array, Ops, Vector, cross, normalize

CHAPMAN = 5.3
"""Softness over c₀²: fits the depth of an exponential skin within 3 % from ⟨n,ω⟩ = c₀ on."""
AZIMUTHS = 8
"""Number of marches along the skin from each voxel."""
LENGTH = 0.5
"""Length of a march along the skin, field units."""
DEEPEST = 12.0
"""Optical depth to the outside beyond which a voxel contributes to no picture."""
FLATTEST = 40.0
"""Ratio of the optical depths along the skin and along its normal above which the skin counts as flat."""
SMOKE, SOLID = 3.0, 6.0
"""Optical depths across matter: below the first it has no skin, above the second it is opaque."""
SEEN = 0.3, 3.0
"""Optical depths to the outside between which a skin's scale height is read. From there come 70 % of the light that a
camera sees along the normal."""
THIN = 0.25
"""Quantile of the scale heights that stands for a field's skins: the thinner ones need the finest steps."""


TURNS = tuple((math.cos(2 * math.pi * k / AZIMUTHS), math.sin(2 * math.pi * k / AZIMUTHS)) for k in range(AZIMUTHS))
"""Cosine and sine of the azimuths."""


def across(ops: Ops, normal: Vector, turn: tuple[Array, Array]) -> tuple[Array, ...]:
    """Return the unit direction perpendicular to the unit vector `normal` at the azimuth `turn`, a pair of TURNS."""
    steep = ops.abs(normal[0]) > 0.7
    zero, one = 0 * normal[0], 0 * normal[0] + 1
    side = ops.where(steep, zero, one), ops.where(steep, one, zero), zero
    u = normalize(ops, cross(normal, side))
    v = cross(normal, u)
    return tuple(turn[0] * a + turn[1] * b for a, b in zip(u, v, strict=True))


def squared_horizon(ops: Ops, out: Array, along: Array, sigma: Array) -> Array:
    """Return c₀² in one direction along the skin; 0 if the skin is as flat as LENGTH and FLATTEST can resolve.

    `out`, `along`: optical depths from a point along its normal and in that direction; `sigma`: density at the point.
    """
    flat = ops.maximum(out / (LENGTH * ops.maximum(sigma, 1e-6)), 1 / FLATTEST)
    c = out / ops.maximum(along, out)
    return ops.maximum(c * c - flat * flat, 0.0)


def softness(ops: Ops, squared: Array, out: Array, inward: Array) -> Array:
    """Return the softness of a skin; 0 in smoke, which has no skin.

    `squared`: mean of :func:`squared_horizon` over the azimuths; `out`, `inward`: optical depths along the normal.
    """
    solid = (out + inward - SMOKE) * (1 / (SOLID - SMOKE))
    return CHAPMAN * squared * ops.minimum(ops.maximum(solid, 0.0), 1.0)


def thickness(out: np.ndarray, inward: np.ndarray, sigma: np.ndarray) -> float:
    """Return the scale height of the thinner skins, the quantile THIN; infinity where nothing is opaque.

    In an exponential skin it is the depth to the outside over the density. `out`, `inward`: optical depths along the
    normal; `sigma`: density there.
    """
    skins = (out > SEEN[0]) & (out < SEEN[1]) & (out + inward > SOLID) & (sigma > 0)
    return float(np.quantile(out[skins] / sigma[skins], THIN)) if skins.any() else math.inf
