"""Lookups without bias: marches to a few random pairs of point and light correct them on average."""

from types import ModuleType

import drjit as dr

from .. import ops
from ..tuning import MARCH_CHANCE
from ..types import Array, Float, Mask, UInt32, Vector, Visibility

TOGETHER = 16
"""Neighbouring lanes that march together, the lanes of the widest processors."""


class Unbiased:
    """A visibility method whose mean is that of `march`: τ = a + (m − a) b/p, where b is 1 with chance p, else 0.

    a is the transmittance of `looked_up` and m that of the march (a control variate; Owen 2013, Monte Carlo theory,
    chapter 8). τ may lie outside of [0, 1]. `salt`: a number unique to the field, so that random numbers of fields are
    independent. `stream`: an opaque seed, set by the renderer.
    """

    def __init__(self, looked_up: Visibility, march: Visibility, salt: int, dj: ModuleType):
        self.looked_up, self.march, self.dj = looked_up, march, dj
        self._salt, self.stream = dr.opaque(dj.UInt32, salt), dr.opaque(dj.UInt32, 0)

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the estimate; 0 on average where the light does not reach."""
        tau = self.looked_up.tau(x, wi, distance, index, active)
        block = dr.arange(self.dj.UInt32, dr.width(x[0])) // TOGETHER
        seed = self.stream ^ (self._salt * 0x9E3779B9)
        u = self.dj.Float(_hash(_hash(seed ^ _hash(block)) ^ self.dj.UInt32(index)) >> 8) * 2.0**-24

        def corrected(tau: Float, x: Vector, wi: Vector, distance: Float) -> Float:
            return tau + (self.march.tau(x, wi, distance, index, True) - tau) * (1 / MARCH_CHANCE)

        return ops.if_stmt((tau, tuple(x), tuple(wi), distance), active & (u < MARCH_CHANCE), corrected,
                          lambda tau, *_: tau, label="march at random")


def _hash(word: Array) -> UInt32:
    """Return the words scrambled (the finaliser of MurmurHash3)."""
    word = (word ^ (word >> 16)) * 0x85EBCA6B
    word = (word ^ (word >> 13)) * 0xC2B2AE35
    return word ^ (word >> 16)
