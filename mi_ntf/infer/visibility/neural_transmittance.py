"""``neural_transmittance``: one query of the ray network per point and light (Shafiei et al. 2021; method.md, section
4)."""

import drjit as dr

from ...core import mixture, spheres
from .. import ops


class NeuralTransmittance:
    """`field`: a :class:`mi_ntf.infer.network.NetworkField`; `profile`: a
    :class:`mi_ntf.infer.profile.DepthProfile` of the same field."""

    def __init__(self, field, profile):
        self.field, self.profile = field, profile

    def tau(self, x, wi, distance, index, active):
        """The ray's τ at x; for a light inside the sphere, over its value at the light, which is where τ is 1."""
        hit, h, mix = self.field.ray_mixture(x, wi, self.profile)
        t = dr.maximum(spheres.coordinate(x, wi), -h)
        depth = mixture.optical_depth(ops, t, mix)
        inside = t + distance < h
        beyond = mixture.optical_depth(ops, dr.select(inside, t + distance, t), mix)
        depth = dr.select(inside, dr.maximum(depth - beyond, 0), dr.maximum(depth, 0))
        return dr.select(hit, dr.exp(-depth), 1)
