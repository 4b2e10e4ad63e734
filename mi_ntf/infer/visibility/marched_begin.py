"""Lookups whose first part, next to the point, is marched: for smoke whose mean free path is shorter than a texel."""

from types import ModuleType

import drjit as dr

from ...core import spheres
from .. import ops
from ..types import Float, Mask, UInt32, Vector, Visibility
from .raymarch import RayMarch

DARK = 1e-5
"""Transmittance of the marched part below which the rest of the ray is not looked up."""


class MarchedBegin:
    """A visibility method: `march` as far as `length`, field units, and `looked_up` from there on.

    Neighbouring rays of a map meet a dense medium at different places, so that interpolation blurs its border over a
    texel. Light that reaches a point of a dense medium at all enters close to it, and this part is marched.
    Where the ray leaves the medium on it, nothing is looked up.
    """

    def __init__(self, looked_up: Visibility, march: RayMarch, length: float, dj: ModuleType):
        self.looked_up, self.march, self._length = looked_up, march, dr.opaque(dj.Float, length)

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the product of both parts."""
        begin = self.march.tau(x, wi, dr.minimum(distance, self._length), index, active)

        # Kernels of lights outside of the sphere hold no march to the light.
        far = distance.state == dr.VarState.Literal and bool(dr.all(distance == dr.inf)[0])
        rest = distance if far else distance - self._length

        def look_up(begin: Float, x: Vector, wi: Vector) -> Float:
            y = tuple(a + self._length * b for a, b in zip(x, wi, strict=True))
            return begin * self.looked_up.tau(y, wi, rest, index, True, sun)

        _, m, h = spheres.chord(ops, x, wi)
        _, end = self.march.volume.extent(m, wi, h)
        further = (rest > 0) & (spheres.coordinate(x, wi) + self._length < end)
        return ops.if_stmt((begin, tuple(x), tuple(wi)), active & further & (begin > DARK), look_up,
                           lambda begin, *_: begin, label="behind the begin")
