"""Where a transmittance map's mixtures come from: the ray network, or a march through the field.

A source has ``fit(o, d, end) → mixture`` for rays through `o` towards the light along `d`, which lies at t' = `end` or
beyond the sphere (infinity: at no distance at all); ``components``; and ``weights``, false for one logistic of weight
1.
"""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...core import logistic, spheres
from .. import ops
from . import two_logistics

CLEAR = -100.0
"""b of a ray that nothing blocks: S(1·(t + 100)) = 1 in float32 for every t of the sphere."""
DEEP = 8.0
"""S(z) is e^z within e^−8, 3e-4, from z = −8 down."""


@dataclass(frozen=True)
class Source:
    """See the module."""

    fit: Any
    components: int
    weights: bool


def network_source(field, profile, inside=True) -> Source:
    """`map_source=network`: the mixture by one query of the ray network; τ = 1 where the ray meets nothing.

    `inside`: some light may lie inside the sphere. The network speaks of whole chords; what lies behind such a light is
    kept from its eyes, and its τ is divided by its value at the light.
    """

    def fit(o, d, end):
        hit, h, mix = field.ray_mixture(o, d, lambda o, d: profile(o, d, begin=end))
        if inside:
            near, light = end < h, dr.minimum(end, h)
            parts = zip(mix, _relative_to(light, mix), strict=True)
            mix = tuple(tuple(dr.select(near, p, q) for p, q in zip(part, whole, strict=True)) for whole, part in parts)
            hit &= end > -h
        share = 1 / len(mix)
        return tuple((dr.select(hit, w, share), dr.select(hit, a, 1), dr.select(hit, b, CLEAR)) for w, a, b in mix)

    return Source(fit, field.components, inside or field.components > 1)


def _relative_to(light, mix):
    """The mixture over its own value at t' = `light`, which may have underflowed in the midst of matter.

    A part that far behind its centre is the exponential e^(a (t' − light)). A logistic with its centre `DEEP`/a from
    the light has that shape too, and weights of a few thousand at most.
    """
    depths = [logistic.optical_depth(ops, light, a, b) - dr.log(w) for w, a, b in mix]
    least = depths[0]
    for depth in depths[1:]:
        least = dr.minimum(least, depth)
    shares = [dr.exp(least - depth) for depth in depths]
    total = sum(shares[1:], shares[0])
    near = [dr.minimum(b, light + DEEP / a) for _, a, b in mix]
    return tuple(
        (share / (total * logistic.sigmoid(ops, a * (light - b))), a, b)
        for share, b, (_, a, _b) in zip(shares, near, mix, strict=True)
    )


LEVELS = (1e-3, math.log(4 / 3), math.log(2), math.log(4))
"""Optical depths where matter begins and where τ is 3/4, 1/2 and 1/4."""


def field_source(field, profile, components: int = 1, effort=two_logistics.FINE) -> Source:
    """`map_source=field`: march the field once per ray, from the light inwards. One logistic follows in closed form
    from τ's quartiles and the slant of the skin there, two by least squares on levels of τ, with `effort`."""

    def one(o, d, end):
        hit, m, h = spheres.chord(ops, o, d)
        (first, *places), depth = profile(o, d, LEVELS, end)
        normal = field.reflectance(tuple(mi + places[1] * di for mi, di in zip(m, d, strict=True)))[0]
        cos = dr.abs(normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2])
        a, b = logistic.through_quantiles(ops, *places, cos)
        a_part, b_part = _partial(h, first, depth)
        blocked, clear = depth >= LEVELS[-1], ~hit | (depth < LEVELS[0])
        a, b = dr.select(blocked, a, a_part), dr.select(blocked, b, b_part)
        return ((1.0, dr.select(clear, 1, a), dr.select(clear, CLEAR, b)),)

    def two(o, d, end):
        hit, _m, h = spheres.chord(ops, o, d)
        places, depth, last = profile.with_end(o, d, effort.depths, end)
        return two_logistics.fit(places, depth, last, -h, hit & (depth > effort.depths[0]), effort)

    return Source(one if components == 1 else two, components, components > 1)


def _partial(h, begin, depth):
    """(a, b) of a ray that keeps p = e^−depth > 1/4 of the light: a logistic cannot rest at p, so it passes (1 + p)/2
    where the matter begins and p halfway from there to the far end."""
    p = dr.exp(-depth)
    top, low = dr.log((1 + p) / dr.maximum(1 - p, 1e-4)), dr.log(p / dr.maximum(1 - p, 1e-4))
    a = (top - low) / dr.maximum(0.5 * (begin + h), 1e-2)
    return a, begin - top / a
