"""Transmittance of a ray as a sum of logistics, τ(t) = Σ_k w_k S(a_k (t − b_k)); the paper has one of them.

One logistic falls from 1 to 0 once. Rays that graze a silhouette and are blocked behind it fall twice, and smoke lets
some light through: two logistics cut the error of the class three to five times. A mixture is a tuple of ``(w, a, b)``,
w > 0; τ is monotone for any of them. `t`, `a`, `b` as in :mod:`mi_ntf.core.logistic`.
"""

from collections.abc import Sequence
from typing import TypeAlias

from . import logistic
from .ops import Array, Ops

Mixture: TypeAlias = tuple[tuple[Array, Array, Array], ...]
"""``(w, a, b)`` of each logistic."""


def transmittance(ops: Ops, t: Array, mixture: Mixture) -> Array:
    """Return τ(t)."""
    return sum((w * logistic.transmittance(ops, t, a, b) for w, a, b in mixture[1:]),
               mixture[0][0] * logistic.transmittance(ops, t, *mixture[0][1:]))


def optical_depth(ops: Ops, t: Array, mixture: Mixture) -> Array:
    """Return −ln τ(t), which is finite where τ itself has underflowed.

    It is the least depth of the components, corrected by the others.
    """
    depths = [logistic.optical_depth(ops, t, a, b) - ops.log(w) for w, a, b in mixture]
    least = depths[0]
    for depth in depths[1:]:
        least = ops.minimum(least, depth)
    total = ops.exp(least - depths[0])
    for depth in depths[1:]:
        total = total + ops.exp(least - depth)
    return least - ops.log(total)


def from_outputs(ops: Ops, pairs: Sequence[tuple[Array, Array]], logits: Sequence[Array], h: Array) -> Mixture:
    """Return the mixture of network outputs, with τ(h) = 1 at the light-side end `h` of the chord.

    `pairs`: slopes and centres; `logits`: of the weights besides the first, which is 0. A single logistic has none, and
    stays as it is (the paper's).
    """
    if not logits:
        return ((0 * h + 1, *pairs[0]),)
    # |logits| is bounded: a component without weight would get no gradient, and its logarithm would overflow.
    scores = [0 * h, *(6 * logistic.tanh(ops, v / 6) for v in logits)]
    # The quotient is taken of logarithms. Where all centres lie beyond the exit, τ(h) falls to 1e-35 (sigmoid's clip):
    # float32 holds its inverse, but not the inverse's square, which the quotient's derivative needs.
    top = ops.log(transmittance(ops, h, tuple((ops.exp(s), a, b) for s, (a, b) in zip(scores, pairs, strict=True))))
    return tuple((ops.exp(s - top), a, b) for s, (a, b) in zip(scores, pairs, strict=True))
