"""Transmittance of a ray as one logistic (method.md, section 4; Shafiei et al. 2021, eq. 7).

    τ(t) = S(a (t − b)),      S(z) = 1/(1 + e^−z)

τ is the transmittance from the point at t to the light-side end of the chord: 1 near the light, falling away from it.
`a` > 0 is the slope in inverse field units (a quarter of it is the largest dτ/dt), `b` the place where half of the
light is gone. All forms have finite values and gradients in float32 for every finite input.
"""

MAX_LOG_SLOPE = 6.5
"""ln of the largest slope, a ≤ 665: a step of width 0.007 of the unit sphere's radius. Learned skins are no sharper,
and above it float32 products a·(t − b) lose the fourth digit of τ."""
MAX_SLOPE = 665.0
MAX_CENTRE = 1.2
"""|b| stays below this many half chords. Beyond 1, so that an empty central chord can reach τ = 1 at its far end."""
_CLIP = 80.0  # e^80 is finite in float32; S differs from 0 or 1 by less than any float32 can tell.


def sigmoid(ops, z):
    """S(z), clipped where float32 exponentials would overflow."""
    z = ops.minimum(ops.maximum(z, -_CLIP), _CLIP)
    return 1 / (1 + ops.exp(-z))


def softplus(ops, z):
    """ln(1 + e^z) without overflow: max(z, 0) + ln(1 + e^−|z|).

    max(z, 0) is written (z + |z|)/2: frameworks disagree on the derivative of a tie, this form has ½ at 0 in all of
    them.
    """
    size = ops.abs(z)
    return (z + size) / 2 + ops.log(1 + ops.exp(-size))


def transmittance(ops, t, a, b):
    """τ(t) = S(a (t − b)), in [0, 1], monotone in t."""
    return sigmoid(ops, a * (t - b))


def optical_depth(ops, t, a, b):
    """−ln τ(t) = softplus(−a (t − b)); finite where τ itself has long underflowed."""
    return softplus(ops, -a * (t - b))


def parameters(ops, raw_a, raw_b, h):
    """Network outputs to ``(a, b)``: a = exp(raw_a) bounded by exp(±MAX_LOG_SLOPE), |b| ≤ MAX_CENTRE · h.

    The bound on ln a is a scaled tanh: identity to first order around 0, finite gradients everywhere.
    """
    log_a = MAX_LOG_SLOPE * tanh(ops, raw_a / MAX_LOG_SLOPE)
    return ops.exp(log_a), MAX_CENTRE * h * tanh(ops, raw_b)


def tanh(ops, z):
    """2 S(2z) − 1."""
    return 2 * sigmoid(ops, 2 * z) - 1


def through_quantiles(ops, t75, t50, t25, cos):
    """The logistic through three crossings, ``(a, b)`` in closed form.

    `t75`, `t50`, `t25`: where τ is 3/4, 1/2, 1/4 (t75 ≥ t50 ≥ t25: τ falls away from the light, towards smaller t).
    logit(3/4) − logit(1/4) = 2 ln 3, hence a = 2 ln 3/(t75 − t25).

    b = t50 for a symmetric profile; others are met where cameras look. `cos`, in (0, 1]: the light's, on the skin that
    the ray enters. Who looks at that skin at a cosine of 2/3 sees τ = uʳ, r = 2/(3 cos), with u uniform in [0, 1]. The
    mean of S − τ over u vanishes for a b that lies k times the quartiles' asymmetry closer to the light; k here is that
    of densities that rise exponentially into a skin, τ = exp(−e^−t), and that of constant ones, which are asymmetric
    the other way, from cos = 1 to 0.05.
    """
    slope = 2.1972245773362196 / ops.maximum(t75 - t25, 1e-6)
    bent = (t75 - t50) - (t50 - t25)
    slant = -ops.log(ops.maximum(cos, 0.05))
    share = ops.where(bent > 0, 0.45 + slant * (0.25 + 0.125 * slant), 0.54 + 0.025 * slant * slant)
    return ops.minimum(slope, MAX_SLOPE), t50 + share * bent
