"""Two logistics through the quantiles of one ray's τ: a start in closed form, then a few steps of least squares.

A ray that is half blocked at a silhouette and blocked behind it has a plateau; one that leaves smoke keeps some light
for good. The start splits τ there, at the widest gap between levels, and gives each part the logistic through its
quartiles. Levenberg and Marquardt's steps then fit τ itself at all levels, evenly spaced in τ as the light that a skin
uses up is. One march makes the levels, so the fit costs a few per cent of a texel.
"""

import math
from typing import NamedTuple

import drjit as dr

from ...core import logistic
from .. import ops


class Effort(NamedTuple):
    """`levels`: of τ, seen from the light; `steps` of least squares; `sloping`: as many from another start as well, for
    rays that keep some light, whose second logistic is 1 throughout otherwise, which steps leave so."""

    levels: tuple[float, ...]
    steps: int
    sloping: int = 0

    @property
    def depths(self) -> tuple[float, ...]:
        """Optical depths of the levels."""
        return tuple(-math.log(level) for level in self.levels)


FINE = Effort((0.999, 0.97, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.03), 4)
ROUGH = Effort((0.999, 0.9, 0.7, 0.5, 0.3, 0.1), 1)
"""Where texels are so large that their blur hides more: pictures of `statue`, `globe` and `skull` by an atlas err alike
with two steps."""
SMOKE = Effort(FINE.levels, FINE.steps, 10)
"""Smoke dims light all along a ray, which one logistic above a floor follows badly: even smoke that fills the sphere by
0.031 (RMS of τ), and by the other start by 0.021."""
END, LEFT = 3.0, 0.9
"""Of the second logistic there, to begin with: slope, field units, and value where the ray leaves the sphere."""
CLEAR = -100.0
PLATEAU = 0.05
"""Light that a ray keeps for good, at least."""
_SLOPE = 2.1972245773362196  # logit(3/4) − logit(1/4)


def fit(places, depth, last, far, hit, effort: Effort = FINE):
    """The mixture of rays whose τ passes the levels of `effort` at `places` (arbitrary where it does not), ends at
    e^−`depth` (exact up to the last level), meets no matter below t' = `last` and leaves the sphere at `far`; rays
    without `hit` are clear."""
    rest = dr.select(depth >= effort.depths[-1], 0, dr.exp(-depth))
    reached = [depth >= d for d in effort.depths]
    t = [dr.select(r, p, last) for r, p in zip(reached, places, strict=True)]
    tau = [dr.select(r, level, rest) for r, level in zip(reached, effort.levels, strict=True)]
    start = _start(t, tau, reached, rest, effort.levels)
    state = _least_squares(t, tau, start, effort.steps)
    if effort.sloping:
        t, tau = [*t, far], [*tau, rest]  # what falls goes on falling
        other = _least_squares(t, tau, _sloping(start, far, rest), effort.sloping)
        better = _cost(_residuals(other, t, tau)[0]) < _cost(_residuals(state, t, tau)[0])
        state = tuple(dr.select(better, a, b) for a, b in zip(other, state, strict=True))
    w, a1, b1, a2, b2 = _parameters(state)
    return tuple(
        (dr.select(hit, w, 0.5), dr.select(hit, a, 1), dr.select(hit, b, CLEAR))
        for w, a, b in ((w, a1, b1), (1 - w, a2, b2))
    )


def _start(t, tau, reached, rest, levels):
    """(logit w, ln a₁, b₁, ln a₂, b₂)."""
    split, widest = 0 * rest + 0.5, 0 * rest - 1
    first = next(j for j, level in enumerate(levels) if level <= 0.9)
    for j in range(first, len(levels) - 2):
        gap = t[j] - t[j + 1]
        better = reached[j + 1] & (gap > widest)
        split = dr.select(better, (levels[j] + levels[j + 1]) / 2, split)
        widest = dr.select(better, gap, widest)
    plateau = rest > PLATEAU
    split = dr.select(plateau, rest, split)
    begin = [_place(split + (1 - split) * q, t, tau) for q in (0.75, 0.5, 0.25)]
    end = [_place(split * q, t, tau) for q in (0.75, 0.5, 0.25)]
    log_a1, log_a2 = (dr.log(_SLOPE / dr.maximum(s[0] - s[2], _SLOPE / logistic.MAX_SLOPE)) for s in (begin, end))
    odds = dr.log(dr.maximum(1 - split, 1e-4)) - dr.log(split)
    return odds, log_a1, begin[1], dr.select(plateau, 0, log_a2), dr.select(plateau, CLEAR, end[1])


def _sloping(start, far, rest):
    """`start` with a second logistic that falls to `LEFT` at `far` where a ray keeps some light."""
    plateau, weight = rest > PLATEAU, dr.minimum(rest / LEFT, 0.95)
    end = dr.log(1 - weight) - dr.log(weight), math.log(END), far - math.log(LEFT / (1 - LEFT)) / END
    odds, log_a1, b1, *second = start
    odds, *second = (dr.select(plateau, a, b) for a, b in zip(end, (odds, *second), strict=True))
    return odds, log_a1, b1, *second


def _place(level, t, tau):
    """Where τ = `level`, linear between the known places."""
    result = t[0]
    for j in range(len(t) - 1):
        share = (tau[j] - level) / dr.maximum(tau[j] - tau[j + 1], 1e-6)
        result = dr.select(level < tau[j], t[j] + dr.minimum(share, 1) * (t[j + 1] - t[j]), result)
    return result


def _parameters(p):
    return logistic.sigmoid(ops, p[0]), dr.exp(p[1]), p[2], dr.exp(p[3]), p[4]


def _residuals(p, t, tau, derivatives=False):
    """Per point the error of τ, and its derivatives by the five parameters."""
    w, a1, b1, a2, b2 = _parameters(p)
    errors, rows = [], []
    for place, level in zip(t, tau, strict=True):
        s1, s2 = (logistic.sigmoid(ops, a * (place - b)) for a, b in ((a1, b1), (a2, b2)))
        errors.append(w * s1 + (1 - w) * s2 - level)
        if derivatives:
            e1, e2 = w * s1 * (1 - s1) * a1, (1 - w) * s2 * (1 - s2) * a2
            rows.append((w * (1 - w) * (s1 - s2), e1 * (place - b1), -e1, e2 * (place - b2), -e2))
    return errors, rows


def _cost(errors):
    return sum(e * e for e in errors)


def _least_squares(t, tau, start, steps: int):
    """Levenberg–Marquardt; a step that does not lower the error is not taken."""
    errors, _ = _residuals(start, t, tau)
    damping = 0 * start[0] + 0.01
    count = dr.opaque(dr.uint32_array_t(type(damping)), steps)

    def body(i, p, cost, damping):
        errors, rows = _residuals(p, t, tau, True)
        size = range(5)
        matrix = [[sum(r[i] * r[j] for r in rows) for j in size] for i in size]
        slope = [sum(r[i] * e for r, e in zip(rows, errors, strict=True)) for i in size]
        for k in size:
            matrix[k][k] = matrix[k][k] * (1 + damping) + 1e-7
        step = _solve(matrix, slope)
        limit = (2.0, 1.0, 0.2, 1.0, 0.2)
        q = tuple(a - dr.clip(b, -c, c) for a, b, c in zip(p, step, limit, strict=True))
        top = math.log(logistic.MAX_SLOPE)
        q = (dr.clip(q[0], -8, 8), dr.clip(q[1], -2, top), q[2], dr.clip(q[3], -2, top), q[4])
        after = _cost(_residuals(q, t, tau)[0])
        better = after < cost
        p = tuple(dr.select(better, a, b) for a, b in zip(q, p, strict=True))
        return i + 1, p, dr.minimum(after, cost), dr.select(better, damping * 0.2, damping * 5)

    zero = dr.zeros(dr.uint32_array_t(type(damping)), dr.width(damping))
    state = (zero, tuple(start), _cost(errors), damping)
    return dr.while_loop(state=state, cond=lambda i, p, cost, damping: i < count, body=body, label="two logistics")[1]


def _solve(matrix, right):
    """Cholesky's solution of the positive definite `matrix`, a list of rows; overwritten."""
    n = len(right)
    x = list(right)
    for j in range(n):
        inverse = dr.rsqrt(dr.maximum(matrix[j][j] - sum(matrix[j][k] * matrix[j][k] for k in range(j)), 1e-12))
        for i in range(j + 1, n):
            matrix[i][j] = (matrix[i][j] - sum(matrix[i][k] * matrix[j][k] for k in range(j))) * inverse
        x[j] = (x[j] - sum(matrix[j][k] * x[k] for k in range(j))) * inverse
        matrix[j][j] = inverse
    for j in reversed(range(n)):
        x[j] = (x[j] - sum(matrix[i][j] * x[i] for i in range(j + 1, n))) * matrix[j][j]
    return x
