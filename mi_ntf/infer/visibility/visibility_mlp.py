"""``visibility_mlp``: NeRV's network of a point and a direction (Srinivasan et al. 2021), the baseline: a query per
point and light, not monotone along a ray."""

import drjit as dr

from ...core import spheres
from ...core.architecture import NO_VISIBILITY
from ...core.errors import MiNtfError
from .. import ops
from .method import Method, Options

SHORT = 1e-5
"""Ways through less of the sphere pass nothing: of a light or a point on it, rounding decides on which side it is."""


class VisibilityMLP:
    """`field`: a :class:`mi_ntf.infer.network.NetworkField` with the baseline's network (`mi-ntf train
    --visibility-mlp`); MiNtfError if it has none.

    The network knows directions, no distances: a light inside the sphere is dimmed by what lies behind it as well, as
    in the original.
    """

    def __init__(self, field):
        if not field.has_visibility:
            raise MiNtfError(NO_VISIBILITY)
        self.field = field

    def tau(self, x, wi, distance, index, active):
        """The network's τ from `x`, or from where its ray enters the sphere, to where it leaves."""
        hit, m, h = spheres.chord(ops, x, wi)
        here = spheres.coordinate(x, wi)
        t = dr.maximum(here, -h)
        way = dr.minimum(here + distance, h) - t
        tau = self.field.visibility(tuple(a + t * b for a, b in zip(m, wi, strict=True)), wi)
        return dr.select(hit & (way > SHORT), tau, 1)


def build(medium, table, options: Options, dj, keep) -> VisibilityMLP:
    """See :class:`mi_ntf.infer.visibility.method.Method`."""
    return VisibilityMLP(medium.field.network)


METHOD = Method(
    name="visibility_mlp",
    summary="one query of a network of a point and a direction per point and light: the baseline",
    build=build,
    needs=lambda medium: medium.field.header.architecture.visibility is not None,
)
