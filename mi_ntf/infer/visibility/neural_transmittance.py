"""``neural_transmittance``: one query of the ray network per point and light (Shafiei et al. 2021; method.md, section
4)."""

import drjit as dr

from ...core import logistic, spheres
from .. import ops


class NeuralTransmittance:
    """`field`: a :class:`mi_ntf.infer.network.NetworkField`."""

    def __init__(self, field):
        self.field = field

    def tau(self, x, wi, distance, index, active):
        """S(a (t' − b)); for a light inside the sphere, over its value at the light, which is where τ is 1."""
        hit, _m, h, a, b = self.field.transmittance_parameters(x, wi)
        t = dr.maximum(spheres.coordinate(x, wi), -h)
        depth = logistic.optical_depth(ops, t, a, b)
        inside = t + distance < h
        beyond = logistic.optical_depth(ops, dr.select(inside, t + distance, t), a, b)
        depth = dr.select(inside, dr.maximum(depth - beyond, 0), depth)
        return dr.select(hit, dr.exp(-depth), 1)
