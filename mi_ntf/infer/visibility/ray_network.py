"""``ray_network``: one query of the ray network per point and light (Shafiei et al. 2021)."""

from types import ModuleType

import drjit as dr

from ...core import mixture, spheres
from .. import ops, tuning
from ..lights import LightTable
from ..network import NetworkField
from ..profile import DepthProfile
from ..types import Float, Mask, UInt32, Vector
from .method import Keep, Medium, Method, Options


class RayNetwork:
    """The ray network of `field`; `profile` marches through the same field."""

    def __init__(self, field: NetworkField, profile: DepthProfile):
        self.field, self.profile = field, profile

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the ray's τ at x; for a light inside the sphere, divided by its value at the light.

        The network's inputs then leave out the matter behind the light.
        """
        here = spheres.coordinate(x, wi)
        light = here + distance
        hit, h, mix = self.field.ray_mixture(x, wi, lambda o, d: self.profile(o, d, begin=light))
        t = dr.maximum(here, -h)
        depth = mixture.optical_depth(ops, t, mix)
        inside = light < h
        beyond = mixture.optical_depth(ops, dr.select(inside, light, t), mix)
        depth = dr.select(inside, dr.maximum(depth - beyond, 0), dr.maximum(depth, 0))
        return dr.select(hit & (light > -h), dr.exp(-depth), 1)


def build(medium: Medium, table: LightTable | None, options: Options, dj: ModuleType, keep: Keep) -> RayNetwork:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    step = dr.opaque(dj.Float, options.step * tuning.NETWORK_STEP)
    return RayNetwork(medium.field.network, DepthProfile(medium.source, step))


METHOD = Method(
    name="ray_network",
    summary="the ray network asked per point and light, as in the paper; networks that read a ray's depths march for "
            "them first",
    build=build,
    needs=lambda medium: medium.field.trained,
)
