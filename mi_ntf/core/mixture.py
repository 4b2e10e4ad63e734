"""Transmittance of a ray as a sum of logistics, τ(t) = Σ_k w_k S(a_k (t − b_k)); one of them is the paper's.

One logistic falls from 1 to 0 once. Rays that graze a silhouette and are blocked behind it fall twice, and behind smoke
some light remains: two logistics cut the error of the class three to five times. A mixture is a tuple of
``(w, a, b)``, w > 0; τ is monotone for any of them. `t`, `a`, `b` as in :mod:`mi_ntf.core.logistic`.
"""

from . import logistic


def transmittance(ops, t, mixture):
    """τ(t)."""
    return sum((w * logistic.transmittance(ops, t, a, b) for w, a, b in mixture[1:]),
               mixture[0][0] * logistic.transmittance(ops, t, *mixture[0][1:]))


def optical_depth(ops, t, mixture):
    """−ln τ(t), finite where τ itself has underflowed: the least depth of the components, corrected by the others."""
    depths = [logistic.optical_depth(ops, t, a, b) - ops.log(w) for w, a, b in mixture]
    least = depths[0]
    for depth in depths[1:]:
        least = ops.minimum(least, depth)
    total = ops.exp(least - depths[0])
    for depth in depths[1:]:
        total = total + ops.exp(least - depth)
    return least - ops.log(total)


def from_outputs(ops, pairs, logits, h):
    """The mixture of the slopes and centres `pairs`, weights by softmax of (0, `logits`…), divided by its value at the
    light-side end h: so τ(h) = 1 whatever the network says. One logistic alone stays as it is (the paper's)."""
    if not logits:
        return ((0 * h + 1, *pairs[0]),)
    # |logits| is bounded: a component that has lost all weight would get no gradient, and its logarithm overflow.
    scores = [0 * h, *(6 * logistic.tanh(ops, v / 6) for v in logits)]
    # Divided as logarithms: where all centres lie beyond the exit, τ(h) falls to 1e-35 (sigmoid's clip), whose inverse
    # float32 holds, but not the inverse's square, which the quotient's derivative needs.
    top = ops.log(transmittance(ops, h, tuple((ops.exp(s), a, b) for s, (a, b) in zip(scores, pairs, strict=True))))
    return tuple((ops.exp(s - top), a, b) for s, (a, b) in zip(scores, pairs, strict=True))
