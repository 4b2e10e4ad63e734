"""Phase functions of fields that scatter light as smoke does, and the reflectance of matter with a phase function."""

from types import ModuleType

import drjit as dr

from ..core import henyey_greenstein
from ..core.ops import dot
from . import ops
from .scatter import tangents
from .shade import Lobe, Reflectance
from .types import Float, Vector


class HenyeyGreenstein:
    """Phase function of :mod:`mi_ntf.core.henyey_greenstein`, the same at all points.

    `g`: asymmetry in (−1, 1), opaque to kernels; `dj`: Dr.Jit module of the back end.
    """

    def __init__(self, g: float, dj: ModuleType):
        self._g: Float = dr.opaque(dj.Float, g)

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Vector, Float]:
        """Return value and density of light scattered from `wi` to `wo` (:class:`mi_ntf.infer.shade.Lobe`)."""
        value = henyey_greenstein.phase(ops, self._g, dr.clip(-dot(wi, wo), -1, 1))
        return (value, value, value), value

    def sample(self, wo: Vector, u1: Float, u2: tuple[Float, Float]) -> Vector:
        """Return a direction to the light, of the density of :meth:`evaluate`; `u1` is not used."""
        cos = dr.clip(henyey_greenstein.deflection(self._g, u2[0]), -1, 1)
        sin, phi = dr.safe_sqrt(1 - cos * cos), 2 * dr.pi * u2[1]
        s, t = tangents(wo)
        x, y = sin * dr.cos(phi), sin * dr.sin(phi)
        return tuple(x * a + y * b - cos * c for a, b, c in zip(s, t, wo, strict=True))


def smoke(albedo: Vector, lobe: Lobe) -> Reflectance:
    """Return the reflectance of points that scatter light by a phase function: no normal and no specular lobe."""
    zero, one = dr.zeros(type(albedo[0]), dr.width(albedo[0])), dr.ones(type(albedo[0]), dr.width(albedo[0]))
    return Reflectance((zero, zero, zero), albedo, one, (zero, zero, zero), zero, lobe=lobe)
