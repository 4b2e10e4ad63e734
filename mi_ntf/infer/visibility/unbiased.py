"""Lookups without bias: a march to few of the pairs of point and light, drawn at random, corrects them on average."""

from types import ModuleType

import drjit as dr

CHANCE = 1 / 16
"""Chance of a march. It costs this fraction of marching everywhere; the noise that it adds is four times what a lookup
errs by, and averages over lights and samples as all noise does."""
TOGETHER = 16
"""Neighbours that march together: lanes of the widest processors."""


class Unbiased:
    """A visibility method whose mean is that of `march`: τ = a + (m − a) b/p, where b is 1 with chance p, else 0.

    a is `looked_up`'s answer and m is the march's (a control variate; Owen 2013, Monte Carlo theory, chapter 8). τ may
    lie outside of [0, 1]. `salt`: a number that other fields do not have, so that their draws are independent.
    `stream`: an opaque seed, set by the renderer.
    """

    def __init__(self, looked_up, march, salt: int, dj: ModuleType):
        self.looked_up, self.march, self.dj = looked_up, march, dj
        self._salt, self.stream = dr.opaque(dj.UInt32, salt), dr.opaque(dj.UInt32, 0)

    def tau(self, x, wi, distance, index, active):
        """Return the estimate; 0 on average where the light does not reach."""
        tau = self.looked_up.tau(x, wi, distance, index, active)
        block = dr.arange(self.dj.UInt32, dr.width(x[0])) // TOGETHER
        seed = self.stream ^ (self._salt * 0x9E3779B9)
        u = self.dj.Float(_hash(_hash(seed ^ _hash(block)) ^ self.dj.UInt32(index)) >> 8) * 2.0**-24

        def corrected(tau, x, wi, distance):
            return tau + (self.march.tau(x, wi, distance, index, True) - tau) * (1 / CHANCE)

        return dr.if_stmt((tau, tuple(x), tuple(wi), distance), active & (u < CHANCE), corrected,
                          lambda tau, *_: tau, label="march at random")


def _hash(word):
    """Return the words scrambled (the finaliser of MurmurHash3)."""
    word = (word ^ (word >> 16)) * 0x85EBCA6B
    word = (word ^ (word >> 13)) * 0xC2B2AE35
    return word ^ (word >> 16)
