"""Lookups for most lights, and marches to the few that outshine the others by far, whose shadows stay sharp."""

from types import ModuleType

import drjit as dr
import numpy as np

from .. import ops
from ..types import Float, Mask, UInt32, Vector, Visibility


class MarchedSuns:
    """A visibility method: `march` for suns, `looked_up` for all other lights.

    `suns`: mask (n,) of the rows of a table; None for sampled lights, each of which says if it is a sun. Neighbouring
    lanes look at one light at a time, so few marches hardly cost time.
    """

    def __init__(self, looked_up: Visibility, march: Visibility, suns: np.ndarray | None, dj: ModuleType):
        self.looked_up, self.march, self.suns, self.dj = looked_up, march, suns, dj
        self._suns = None if suns is None else dj.UInt32(suns.astype(np.uint32))

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the transmittance; marched for suns, looked up otherwise."""
        if self._suns is None:
            sun = self.dj.Bool(False if sun is None else sun)
        else:
            sun = dr.gather(self.dj.UInt32, self._suns, index, active) > 0
        tau = self.looked_up.tau(x, wi, distance, index, active & ~sun)

        def march(_: Float, x: Vector, wi: Vector) -> Float:
            return self.march.tau(x, wi, distance, index, True)

        return ops.if_stmt((tau, tuple(x), tuple(wi)), active & sun, march, lambda tau, *_: tau, label="sun")
