"""Inputs of the transmittance network: the places along the chord at which a ray's optical depth passes some levels.

Seen from the light-side end of the chord, the optical depth D(t) = ∫_t^h σ grows from 0. A ray is described by the
places t_j where D passes the `LEVELS`, and by its depth at the far end. A network that reads them knows the profile's
shape; one that reads the end points of the ray alone has to learn the whole object by heart.

All lengths enter relative to a centre c (half of the light is absorbed) and a width s (between 90 and 10 % of the
light), so one network serves skins of every width, at every place. Arguments are scalar arrays or sequences of them;
`ops` is the namespace of elementary functions.
"""

from collections.abc import Sequence

from . import logistic
from .ops import Array, Ops

LEVELS = (0.03, 0.1, 0.29, 0.69, 1.39, 2.3, 4.0)
"""Optical depths; τ = 0.97, 0.9, 0.75, 0.5, 0.25, 0.1, 0.02."""
FEATURES = 2 * len(LEVELS) + 4
"""Number of the network's inputs."""
MIN_WIDTH = 2e-3
"""Half of the thinnest skin that the field can hold (σ ≤ 665), field units."""
_STEEP = 2.5


def frame(ops: Ops, places: Sequence[Array], total: Array, h: Array) -> tuple[Array, Array, list[Array], list[Array]]:
    """Return ``(c, s, t, crossed)``: centre, width, places and for each level 1 if D reaches it, else 0.

    Parameters
    ----------
    places
        For each level, where D passes it (arbitrary where it does not); −1.2 h in `t` where it does not.
    total
        D at the far end: exact up to the last level, beyond that at least that level.
    h
        Half chord.
    """
    reached = [total >= level for level in LEVELS]
    far = -logistic.MAX_CENTRE * h
    t = [ops.where(r, p, far) for r, p in zip(reached, places, strict=True)]
    crossed = [ops.where(r, 0 * h + 1, 0 * h) for r in reached]
    begin = ops.where(reached[1], t[1], ops.where(reached[0], t[0], h))
    c = ops.where(reached[3], t[3], -h)
    return c, ops.maximum(begin - t[5], MIN_WIDTH), t, crossed


def features(ops: Ops, places: Sequence[Array], total: Array, h: Array) -> list[Array]:
    """Return the network's ``FEATURES`` inputs, all of order 1; arguments as in :func:`frame`."""
    c, s, t, crossed = frame(ops, places, total, h)
    relative = [ops.minimum(ops.maximum((p - c) / s, -4.0), 4.0) for p in t]
    rest = ops.exp(-ops.minimum(total, LEVELS[-1]))
    return [*relative, *crossed, ops.log(s), rest, c / h, ops.minimum((h - c) / s, 20.0) / 10]


def components(ops: Ops, raw: Sequence[Array], places: Sequence[Array], total: Array,
               h: Array) -> list[tuple[Array, Array]]:
    """Return slope and centre of each logistic from the network's outputs `raw`, a then b for each component.

    a = (2/s) exp(±2.5), at most e^6.5; b = c ± 4 s. A component far behind the chord is the light that remains at its
    far end. Zero outputs are the logistic through the middle of the profile.
    """
    c, s, _, _ = frame(ops, places, total, h)
    result = []
    for k in range(len(raw) // 2):
        a = 2 / s * ops.exp(_STEEP * logistic.tanh(ops, raw[2 * k] / _STEEP))
        b = c + 4 * s * logistic.tanh(ops, raw[2 * k + 1] / 4)
        result.append((ops.minimum(a, logistic.MAX_SLOPE), b))
    return result
