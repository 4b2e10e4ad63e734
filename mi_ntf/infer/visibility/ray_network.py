"""``ray_network``: one query of the ray network per point and light (Shafiei et al. 2021; method.md, section 4)."""

import drjit as dr

from ...core import mixture, spheres
from .. import ops, profile
from .method import Method, Options


class RayNetwork:
    """`field`: a :class:`mi_ntf.infer.network.NetworkField`; `profile`: a
    :class:`mi_ntf.infer.profile.DepthProfile` of the same field."""

    def __init__(self, field, profile):
        self.field, self.profile = field, profile

    def tau(self, x, wi, distance, index, active):
        """The ray's τ at x; for a light inside the sphere, over its value at the light, which is where τ is 1. What
        lies behind such a light is kept from the network's eyes."""
        here = spheres.coordinate(x, wi)
        light = here + distance
        hit, h, mix = self.field.ray_mixture(x, wi, lambda o, d: self.profile(o, d, begin=light))
        t = dr.maximum(here, -h)
        depth = mixture.optical_depth(ops, t, mix)
        inside = light < h
        beyond = mixture.optical_depth(ops, dr.select(inside, light, t), mix)
        depth = dr.select(inside, dr.maximum(depth - beyond, 0), dr.maximum(depth, 0))
        return dr.select(hit & (light > -h), dr.exp(-depth), 1)


def build(medium, table, options: Options, dj, keep) -> RayNetwork:
    """See :class:`mi_ntf.infer.visibility.method.Method`."""
    return RayNetwork(medium.field.network, profile.of(medium, options.step * profile.FOR_NETWORKS, dj))


METHOD = Method(
    name="ray_network",
    summary="the ray network asked per point and light, as in the paper; networks that read a ray's depths march for "
            "them first",
    build=build,
)
