"""Lookups for all lights but the few that outshine the others by far: their shadows are marched to, and sharp."""

from types import ModuleType

import drjit as dr
import numpy as np

DRAWN = np.array([False, True])
"""`suns` of lights drawn at random, which are known by the number 1 where they are one, else by 0."""


class MarchedSuns:
    """A visibility method: `march` for those lights of a table that are `suns` (n,) bool, `looked_up` for the others.
    Neighbours look at one light at a time, so a march to few of many is next to none to all else."""

    def __init__(self, looked_up, march, suns: np.ndarray, dj: ModuleType):
        self.looked_up, self.march, self.suns = looked_up, march, suns
        self._suns = dj.UInt32(suns.astype(np.uint32))

    def tau(self, x, wi, distance, index, active):
        """As either."""
        sun = dr.gather(type(self._suns), self._suns, index, active) > 0
        tau = self.looked_up.tau(x, wi, distance, index, active & ~sun)

        def march(_, x, wi):
            return self.march.tau(x, wi, distance, index, True)

        return dr.if_stmt((tau, tuple(x), tuple(wi)), active & sun, march, lambda tau, *_: tau, label="sun")
