"""Optical depth along a ray as a table of places, for smoke, which dims light all along a ray.

A texel holds the places t' at which the depth of its ray, from the light on, reaches fixed fractions of the whole, and
the whole depth. Between the places the depth is Steffen's monotone cubic (1990), which is linear, and exact, where
extinction is constant. Two logistics cannot follow an exponential beyond their lowest level.
"""

import itertools
from collections.abc import Sequence

import drjit as dr

from ...core.mixture import Mixture
from ..profile import DepthProfile
from ..types import Float, Vector
from .raymarch import MAX_OPTICAL_DEPTH

FRACTIONS = (1e-3, 0.1, 0.4, 0.7, 1.0)
"""Fractions of the depth at the places of a texel; the first is where matter begins. The second is near the light,
since dense smoke loses most light there. Equal steps follow. That is a choice and not derived."""
FAINTEST = 1e-4
"""Optical depth of a whole ray below which it is clear."""
SHORTEST = 1e-6
"""Least distance between two places, field units."""


def fit(profile: DepthProfile, o: Vector, d: Vector, end: Float) -> Mixture:
    """Return the tables of rays in the order of a mixture: three places; the other two and the whole depth.

    Arguments as in :class:`mi_ntf.infer.visibility.map_source.Source`.
    """
    _, whole, _ = profile.with_end(o, d, (MAX_OPTICAL_DEPTH,), end)
    whole = dr.minimum(whole, MAX_OPTICAL_DEPTH)
    whole = dr.select(whole > FAINTEST, whole, 0)
    dr.eval(whole)
    # Rounding must not leave the last place unreached.
    levels = [fraction * (1 - 1e-4) * whole for fraction in FRACTIONS]
    places, _, _ = profile.with_end(o, d, levels, end)
    return (places[0], places[1], places[2]), (places[3], places[4], whole)


def tau(t: Float, table: Mixture) -> Float:
    """Return τ at the place `t` of the rays of a table (:func:`fit`)."""
    (*first, third), (*others, whole) = table
    places: Sequence[Float] = (*first, third, *others)
    lengths = [dr.maximum(a - b, SHORTEST) for a, b in itertools.pairwise(places)]
    rates = [(b - a) * dr.rcp(length) for (a, b), length in zip(itertools.pairwise(FRACTIONS), lengths, strict=True)]
    slopes = [_end_slope(rates[0], rates[1], lengths[0], lengths[1])]
    for i in range(1, len(rates)):
        slopes.append(_slope(rates[i - 1], rates[i], lengths[i - 1], lengths[i]))
    slopes.append(_end_slope(rates[-1], rates[-2], lengths[-1], lengths[-2]))
    depth: Float = 0
    for place, length, rate, low, high in zip(places, lengths, rates, slopes, slopes[1:], strict=False):
        u = dr.clip(place - t, 0, length)
        f = u * dr.rcp(length)
        depth += u * (low + f * (3 * rate - 2 * low - high + f * (low + high - 2 * rate)))
    return dr.exp(-whole * depth)


def _slope(before: Float, after: Float, length: Float, next_length: Float) -> Float:
    """Return Steffen's slope between two pieces with these mean slopes, all of them positive."""
    parabola = (before * next_length + after * length) * dr.rcp(length + next_length)
    return dr.minimum(2 * dr.minimum(before, after), parabola)


def _end_slope(rate: Float, other: Float, length: Float, next_length: Float) -> Float:
    """Return Steffen's slope at the free end of a piece beside `other`."""
    fraction = length * dr.rcp(length + next_length)
    return dr.clip(rate * (1 + fraction) - other * fraction, 0, 2 * rate)
