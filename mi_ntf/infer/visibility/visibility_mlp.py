"""``visibility_mlp``: NeRV's network of a point and a direction (Srinivasan et al. 2021), the baseline.

It takes a query per point and light, and is not monotone along a ray.
"""

from types import ModuleType

import drjit as dr

from ...core import spheres
from ...core.architecture import NO_VISIBILITY
from ...core.errors import MiNtfError
from .. import ops
from ..lights import LightTable
from ..network import NetworkField
from ..types import Float, Mask, UInt32, Vector
from .method import Keep, Medium, Method, Options

SHORT = 1e-5
"""Shortest length inside the sphere that counts, field units; it absorbs the rounding of points on the sphere."""


class VisibilityMLP:
    """The baseline's network of `field`; raises MiNtfError if it has none (`mi-ntf train --visibility-mlp`).

    The network knows directions, no distances: a light inside the sphere is also dimmed by the matter behind it, as in
    the original.
    """

    def __init__(self, field: NetworkField):
        if not field.has_visibility:
            raise MiNtfError(NO_VISIBILITY)
        self.field = field

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the network's τ from `x`, or the place where its ray enters the sphere, to where it leaves."""
        hit, m, h = spheres.chord(ops, x, wi)
        here = spheres.coordinate(x, wi)
        t = dr.maximum(here, -h)
        way = dr.minimum(here + distance, h) - t
        tau = self.field.visibility(tuple(a + t * b for a, b in zip(m, wi, strict=True)), wi)
        return dr.select(hit & (way > SHORT), tau, 1)


def build(medium: Medium, table: LightTable | None, options: Options, dj: ModuleType, keep: Keep) -> VisibilityMLP:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    return VisibilityMLP(medium.field.network)


METHOD = Method(
    name="visibility_mlp",
    summary="one query of a network of a point and a direction per point and light: the baseline",
    build=build,
    needs=lambda medium: medium.field.trained and medium.field.header.architecture.visibility is not None,
)
