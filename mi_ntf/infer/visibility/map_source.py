"""Sources of a transmittance map's mixtures: the ray network, or a march through the field."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr

from ...core import logistic, spheres
from ...core.mixture import Mixture
from .. import ops
from ..grid import Density
from ..network import NetworkField
from ..profile import DepthProfile
from ..types import Float, Vector
from . import depth_table, two_logistics

CLEAR = -100.0
"""b of a ray that meets no matter: S(1·(t + 100)) = 1 in float32 for every t of the sphere."""
DEEP = 8.0
"""Argument below whose negative S(z) is e^z within e^−8 = 3e-4."""


def mixture_tau(t: Float, mixture: Mixture) -> Float:
    """Return τ(t), clipped as :func:`mi_ntf.core.logistic.sigmoid` is, which weights may be divided by."""
    return sum(w * dr.rcp(1 + dr.exp(dr.clip(a * (b - t), -20, 80))) for w, a, b in mixture)


@dataclass(frozen=True)
class Source:
    """Source of mixtures of `components` logistics; `weights`: False for one logistic of weight 1.

    A source may fill the same numbers with something else, whose transmittance is `tau`.
    """

    fit: Callable[[Vector, Vector, Float], Mixture]
    """``(o, d, end)`` → mixtures of the rays through `o` along `d` towards a light at t' = `end`, maybe infinity."""
    components: int
    weights: bool
    tau: Callable[[Float, Mixture], Float] = mixture_tau
    """``(t, mixture)`` → τ at the place t' = `t`."""


def network_source(field: NetworkField, profile: DepthProfile, inside: bool = True) -> Source:
    """Return the source `map_source=network`, one query of the ray network per ray; τ = 1 where it meets nothing.

    `inside`: a light may lie inside the sphere. The network describes whole chords. Its inputs then leave out the
    matter behind such a light, and τ is divided by its value at the light.
    """

    def fit(o: Vector, d: Vector, end: Float) -> Mixture:
        hit, h, mix = field.ray_mixture(o, d, lambda o, d: profile(o, d, begin=end))
        if inside:
            near, light = end < h, dr.minimum(end, h)
            parts = zip(mix, _relative_to(light, mix), strict=True)
            mix = tuple(tuple(dr.select(near, p, q) for p, q in zip(part, whole, strict=True)) for whole, part in parts)
            hit &= end > -h
        weight = 1 / len(mix)
        return tuple((dr.select(hit, w, weight), dr.select(hit, a, 1), dr.select(hit, b, CLEAR)) for w, a, b in mix)

    return Source(fit, field.components, inside or field.components > 1)


def _relative_to(light: Float, mix: Mixture) -> Mixture:
    """Return the mixture over its own value at t' = `light`, which may have underflowed inside matter.

    A component far behind its centre is the exponential e^(a (t' − light)). A logistic with its centre `DEEP`/a from
    the light has the same shape, and a weight of at most a few thousand.
    """
    depths = [logistic.optical_depth(ops, light, a, b) - dr.log(w) for w, a, b in mix]
    least = depths[0]
    for depth in depths[1:]:
        least = dr.minimum(least, depth)
    parts = [dr.exp(least - depth) for depth in depths]
    total = sum(parts[1:], parts[0])
    near = [dr.minimum(b, light + DEEP / a) for _, a, b in mix]
    return tuple(
        (part / (total * logistic.sigmoid(ops, a * (light - b))), a, b)
        for part, b, (_, a, _b) in zip(parts, near, mix, strict=True)
    )


def table_source(profile: DepthProfile) -> Source:
    """Return the source of tables of depth, in place of two logistics."""
    return Source(partial(depth_table.fit, profile), 2, True, depth_table.tau)


LEVELS = (1e-3, math.log(4 / 3), math.log(2), math.log(4))
"""Optical depths where matter begins and where τ is 3/4, 1/2 and 1/4."""


def field_source(field: Density, profile: DepthProfile, components: int = 1,
                 effort: two_logistics.Effort = two_logistics.FINE) -> Source:
    """Return the source `map_source=field`, which marches through the field once per ray, from the light inwards.

    One logistic follows in closed form from the quartiles of τ and the slant of the skin there. Two logistics are
    fitted to levels of τ by least squares, with `effort`.
    """

    def one(o: Vector, d: Vector, end: Float) -> Mixture:
        hit, m, h = spheres.chord(ops, o, d)
        (first, t75, t50, t25), depth = profile(o, d, LEVELS, end)
        normal = field.reflectance(tuple(mi + t50 * di for mi, di in zip(m, d, strict=True)))[0]
        cos = dr.abs(normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2])
        a, b = logistic.through_quantiles(ops, t75, t50, t25, cos)
        a_part, b_part = _partial(h, first, depth)
        blocked, clear = depth >= LEVELS[-1], ~hit | (depth < LEVELS[0])
        a, b = dr.select(blocked, a, a_part), dr.select(blocked, b, b_part)
        return ((1.0, dr.select(clear, 1, a), dr.select(clear, CLEAR, b)),)

    def two(o: Vector, d: Vector, end: Float) -> Mixture:
        hit, _m, h = spheres.chord(ops, o, d)
        places, depth, last = profile.with_end(o, d, effort.depths, end)
        return two_logistics.fit(places, depth, last, -h, hit & (depth > effort.depths[0]), effort)

    return Source(one if components == 1 else two, components, components > 1)


def _partial(h: Float, begin: Float, depth: Float) -> tuple[Float, Float]:
    """Return ``(a, b)`` of a ray with remaining transmittance p = e^−depth > 1/4.

    A logistic cannot level off at p, so it passes (1 + p)/2 where the matter begins and p halfway from there to the far
    end.
    """
    p = dr.exp(-depth)
    top, low = dr.log((1 + p) / dr.maximum(1 - p, 1e-4)), dr.log(p / dr.maximum(1 - p, 1e-4))
    a = (top - low) / dr.maximum(0.5 * (begin + h), 1e-2)
    return a, begin - top / a
