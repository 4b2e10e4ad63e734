"""Names of Dr.Jit's array types in annotations, and the interface of a visibility method.

The arrays are those of whichever back end the caller uses, for which Dr.Jit's stubs have no common type: the names tell
readers the type, and type checkers take any.
"""

from typing import Protocol, TypeAlias

from ..core.ops import Array, Vector

Float: TypeAlias = Array
UInt32: TypeAlias = Array
Mask: TypeAlias = Array
Vector3: TypeAlias = Array
"""``mi.Vector3f``, ``mi.Point3f``, ``mi.Point2f`` or a normal, in scene coordinates or on the film."""
Color3: TypeAlias = Array
Ray: TypeAlias = Array
Place: TypeAlias = tuple[Array, ...]
"""Points as a density prepares them for lookups (:class:`mi_ntf.infer.grid.Density`)."""
Reflected: TypeAlias = tuple[Vector, Vector, Float, Vector]
"""Normal, albedo, roughness, specular weight (linear RGB); ranges as in :func:`mi_ntf.core.reference.reflectance`."""

__all__ = ["Array", "Color3", "Float", "Mask", "Place", "Ray", "Reflected", "UInt32", "Vector", "Vector3", "Visibility"]


class Visibility(Protocol):
    """Transmittance from points to lights (:mod:`mi_ntf.infer.visibility`)."""

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Array:
        """Return the transmittance, a number or a colour, in [0, 1].

        Parameters
        ----------
        x, wi
            Points and unit vectors towards the light, field coordinates.
        distance
            Distance of the light, field units; infinite for directional lights.
        index
            Row of the light table; 0 for sampled lights, which are in no table.
        active
            Lanes whose result is used.
        sun
            True where a sampled light is a sun, whose shadow is marched; None: no light is.
        """
