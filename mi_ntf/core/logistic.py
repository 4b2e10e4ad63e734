"""Transmittance of a ray as one logistic (Shafiei et al. 2021, eq. 7).

    τ(t) = S(a (t − b)),      S(z) = 1/(1 + e^−z)

τ is the transmittance from the point at t to the light-side end of the chord: 1 near the light, falling away from it.
`a` > 0 is the slope in inverse field units (a quarter of it is the largest dτ/dt), and τ(b) = ½. All forms have finite
values and gradients in float32 for every finite input.
"""

from .ops import Array, Ops

MAX_LOG_SLOPE = 6.5
"""ln of the largest slope, a ≤ 665: a step of width 0.007 field units. Learned skins are no sharper, and above it
float32 products a·(t − b) lose the fourth digit of τ."""
MAX_SLOPE = 665.0
"""Largest slope, 1/field unit."""
MAX_CENTRE = 1.2
"""Bound of |b|, half chords. It is above 1 so that τ can reach 1 at the far end of an empty central chord."""
_CLIP = 80.0  # e^80 is finite in float32, and S differs from 0 or 1 by less than its precision.


def sigmoid(ops: Ops, z: Array) -> Array:
    """Return S(z), clipped where float32 exponentials would overflow."""
    z = ops.minimum(ops.maximum(z, -_CLIP), _CLIP)
    return 1 / (1 + ops.exp(-z))


def softplus(ops: Ops, z: Array) -> Array:
    """Return ln(1 + e^z) without overflow: max(z, 0) + ln(1 + e^−|z|).

    max(z, 0) is written (z + |z|)/2, whose derivative at 0 is ½ in all frameworks.
    """
    size = ops.abs(z)
    return (z + size) / 2 + ops.log(1 + ops.exp(-size))


def transmittance(ops: Ops, t: Array, a: Array, b: Array) -> Array:
    """Return τ(t) = S(a (t − b)), in [0, 1], monotone in t."""
    return sigmoid(ops, a * (t - b))


def optical_depth(ops: Ops, t: Array, a: Array, b: Array) -> Array:
    """Return −ln τ(t) = softplus(−a (t − b)), which is finite where τ itself has underflowed."""
    return softplus(ops, -a * (t - b))


def parameters(ops: Ops, raw_a: Array, raw_b: Array, h: Array) -> tuple[Array, Array]:
    """Return ``(a, b)`` of network outputs: a = exp(raw_a) within exp(±MAX_LOG_SLOPE), |b| ≤ MAX_CENTRE · h.

    The bound on ln a is a scaled tanh: identity to first order around 0, finite gradients everywhere.
    """
    log_a = MAX_LOG_SLOPE * tanh(ops, raw_a / MAX_LOG_SLOPE)
    return ops.exp(log_a), MAX_CENTRE * h * tanh(ops, raw_b)


def tanh(ops: Ops, z: Array) -> Array:
    """Return 2 S(2z) − 1."""
    return 2 * sigmoid(ops, 2 * z) - 1


def through_quantiles(ops: Ops, t75: Array, t50: Array, t25: Array, cos: Array) -> tuple[Array, Array]:
    """Return the logistic ``(a, b)`` through three crossings, in closed form.

    Parameters
    ----------
    t75, t50, t25
        Places where τ is 3/4, 1/2 and 1/4; t75 ≥ t50 ≥ t25.
    cos
        Cosine of the light, in (0, 1], on the skin that the ray enters.

    Notes
    -----
    logit(3/4) − logit(1/4) = 2 ln 3, hence a = 2 ln 3/(t75 − t25). For a symmetric profile b = t50. For others, b
    minimises the bias that cameras see. A camera that looks at the skin at a cosine of 2/3 sees τ = uʳ, r = 2/(3 cos),
    with u uniform in [0, 1]. The mean of S − τ over u vanishes for a b that lies k times the quartiles' asymmetry
    closer to the light. The two polynomials are fits of k, from cos = 1 to 0.05: for densities that rise exponentially
    into a skin, τ = exp(−e^−t), and for constant ones, whose asymmetry has the other sign.
    """
    slope = 2.1972245773362196 / ops.maximum(t75 - t25, 1e-6)
    asymmetry = (t75 - t50) - (t50 - t25)
    slant = -ops.log(ops.maximum(cos, 0.05))
    k = ops.where(asymmetry > 0, 0.45 + slant * (0.25 + 0.125 * slant), 0.54 + 0.025 * slant * slant)
    return ops.minimum(slope, MAX_SLOPE), t50 + k * asymmetry
