"""Two logistics through the quantiles of one ray's τ: a start in closed form, then a few steps of least squares.

A ray that is half blocked at a silhouette and blocked behind it has a plateau; one that leaves smoke keeps some light.
The start splits τ at the widest gap between levels, and gives each part the logistic through its quartiles. Levenberg
and Marquardt's steps then fit τ itself at all levels, which are about evenly spaced in τ, as the light that a skin
absorbs is. One march makes the levels, so the fit costs a few per cent of a texel.

Lengths are field units. The levels and numbers of steps were tuned on the errors of pictures and of τ on the scenes
`statue`, `globe` and `skull` (``FINE``, ``ROUGH``) and on smoke that fills the sphere (``SMOKE``).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import drjit as dr

from ...core import logistic
from ...core.mixture import Mixture
from .. import ops
from ..types import Array, Float, Mask, UInt32

Places: TypeAlias = Sequence[Float]
Parameters: TypeAlias = tuple[Float, ...]
"""(logit w, ln a₁, b₁, ln a₂, b₂) unless said otherwise."""


class Effort(NamedTuple):
    """Effort of a fit.

    `levels`: of τ, from the light on; `steps` of least squares; `sloping`: number of steps from a second start, for
    rays that keep some light. The first start makes their second logistic 1 throughout, which no step changes.
    """

    levels: tuple[float, ...]
    steps: int
    sloping: int = 0

    @property
    def depths(self) -> tuple[float, ...]:
        """Optical depths of the levels."""
        return tuple(-math.log(level) for level in self.levels)


FINE = Effort((0.999, 0.97, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.03), 4)
ROUGH = Effort((0.999, 0.9, 0.7, 0.5, 0.3, 0.1), 1)
"""Effort for the large texels of an atlas, whose blur hides the error of the fit."""
SMOKE = Effort(FINE.levels, FINE.steps, 10)
"""Effort for smoke, which dims light all along a ray: one logistic above a constant follows that badly."""
END_SLOPE, END_VALUE = 3.0, 0.9
"""Second logistic of the second start: slope, 1/field unit, and value where the ray leaves the sphere."""
CLEAR = -100.0
"""b of a logistic that is 1 throughout the sphere, field units."""
PLATEAU = 0.05
"""Least transmittance of a whole ray that counts as a plateau."""
_SLOPE = 2.1972245773362196  # logit(3/4) − logit(1/4)


def fit(places: Sequence[Float], depth: Float, last: Float, far: Float, hit: Mask, effort: Effort = FINE) -> Mixture:
    """Return the mixture of each ray.

    Parameters
    ----------
    places
        Where τ passes the levels of `effort` (arbitrary where it does not).
    depth
        Optical depth of the whole ray, exact up to the last level.
    last, far
        Places t' below which the ray meets no matter, and where it leaves the sphere.
    hit
        Rays that are not `hit` are clear.
    """
    rest = dr.select(depth >= effort.depths[-1], 0, dr.exp(-depth))
    reached = [depth >= d for d in effort.depths]
    t = [dr.select(r, p, last) for r, p in zip(reached, places, strict=True)]
    tau = [dr.select(r, level, rest) for r, level in zip(reached, effort.levels, strict=True)]
    start = _start(t, tau, reached, rest, effort.levels)
    state = _least_squares(t, tau, start, effort.steps)
    if effort.sloping:
        t, tau = [*t, far], [*tau, rest]  # the light goes on falling to the far end
        other = _least_squares(t, tau, _sloping(start, far, rest), effort.sloping)
        better = _cost(_residuals(other, t, tau)[0]) < _cost(_residuals(state, t, tau)[0])
        state = tuple(dr.select(better, a, b) for a, b in zip(other, state, strict=True))
    w, a1, b1, a2, b2 = _parameters(state)
    return tuple(
        (dr.select(hit, w, 0.5), dr.select(hit, a, 1), dr.select(hit, b, CLEAR))
        for w, a, b in ((w, a1, b1), (1 - w, a2, b2))
    )


def _start(t: Places, tau: Places, reached: Sequence[Mask], rest: Float, levels: Sequence[float]) -> Parameters:
    """Return the parameters of the start in closed form."""
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


def _sloping(start: Parameters, far: Float, rest: Float) -> Parameters:
    """Return `start` with a second logistic that falls to `END_VALUE` at `far` where a ray keeps some light."""
    plateau, weight = rest > PLATEAU, dr.minimum(rest / END_VALUE, 0.95)
    shift = math.log(END_VALUE / (1 - END_VALUE)) / END_SLOPE
    end = dr.log(1 - weight) - dr.log(weight), math.log(END_SLOPE), far - shift
    odds, log_a1, b1, *second = start
    odds, *second = (dr.select(plateau, a, b) for a, b in zip(end, (odds, *second), strict=True))
    return odds, log_a1, b1, *second


def _place(level: Float, t: Places, tau: Places) -> Float:
    """Return the place where τ = `level`, by linear interpolation."""
    result = t[0]
    for j in range(len(t) - 1):
        fraction = (tau[j] - level) / dr.maximum(tau[j] - tau[j + 1], 1e-6)
        result = dr.select(level < tau[j], t[j] + dr.minimum(fraction, 1) * (t[j + 1] - t[j]), result)
    return result


def _parameters(p: Parameters) -> Parameters:
    """Return (w, a₁, b₁, a₂, b₂)."""
    return logistic.sigmoid(ops, p[0]), dr.exp(p[1]), p[2], dr.exp(p[3]), p[4]


def _residuals(p: Parameters, t: Places, tau: Places,
               derivatives: bool = False) -> tuple[list[Float], list[tuple[Float, ...]]]:
    """Return the error of τ at each place and, if asked for, its derivatives by the five parameters."""
    w, a1, b1, a2, b2 = _parameters(p)
    errors: list[Float] = []
    rows: list[tuple[Float, ...]] = []
    for place, level in zip(t, tau, strict=True):
        s1, s2 = (logistic.sigmoid(ops, a * (place - b)) for a, b in ((a1, b1), (a2, b2)))
        errors.append(w * s1 + (1 - w) * s2 - level)
        if derivatives:
            e1, e2 = w * s1 * (1 - s1) * a1, (1 - w) * s2 * (1 - s2) * a2
            rows.append((w * (1 - w) * (s1 - s2), e1 * (place - b1), -e1, e2 * (place - b2), -e2))
    return errors, rows


def _cost(errors: list[Float]) -> Float:
    return sum(e * e for e in errors)


def _least_squares(t: Places, tau: Places, start: Parameters, steps: int) -> Parameters:
    """Return the parameters after Levenberg–Marquardt steps; steps that do not lower the error are rejected."""
    errors, _ = _residuals(start, t, tau)
    damping = 0 * start[0] + 0.01
    uint = dr.uint32_array_t(type(damping))
    count = dr.opaque(uint, steps)

    def body(i: UInt32, p: Parameters, cost: Float, damping: Float) -> tuple[Array, ...]:
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

    state = (dr.zeros(uint, dr.width(damping)), tuple(start), _cost(errors), damping)
    result: Parameters = ops.while_loop(
        state=state, cond=lambda i, p, cost, damping: i < count, body=body, label="two logistics")[1]
    return result


def _solve(matrix: list[list[Float]], right: list[Float]) -> list[Float]:
    """Return Cholesky's solution for the positive definite `matrix`, a list of rows, which is overwritten."""
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
