"""Phase function of Henyey and Greenstein (1941), for matter that scatters light instead of reflecting it.

Its asymmetry g in (−1, 1) is the mean cosine of deflection: 0 scatters evenly into all directions, positive values
prefer to continue forward, negative ones send light back.
"""

import math

from .ops import Array, Ops

INV_4PI = 1 / (4 * math.pi)


def phase(ops: Ops, g: Array, cos: Array) -> Array:
    """Return (1 − g²)/(4π (1 + g² − 2 g cos)^{3/2}) in 1/sr; its integral over all directions is 1.

    Parameters
    ----------
    cos
        Cosine of the deflection, between the directions in which light travels before and after: −⟨ω_i,ω_o⟩ of the
        directions from the point to the light and to the viewer. It is −1 where the light is at the viewer.
    """
    base = 1 + g * g - 2 * g * cos
    return INV_4PI * (1 - g * g) / (base * ops.sqrt(base))


def deflection(g: Array, u: Array) -> Array:
    """Return the cosine of deflection of which the fraction `u` in [0, 1] of the light has less.

    The usual inverse divides by g. With x = 2u − 1 the same is (x (1 + g²) + g (x² (1 + g²) + 3 − g²)/2)/(1 + g x)².
    """
    x, square = 2 * u - 1, g * g
    above = x * (1 + square) + g / 2 * (x * x * (1 + square) + 3 - square)
    below = 1 + g * x
    return above / (below * below)
