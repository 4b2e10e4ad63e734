"""Names of Dr.Jit's array types in annotations, and of what holds them.

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
Reflected: TypeAlias = tuple[Vector, Vector, Float, Float]
"""Normal, albedo, roughness and specular weight; ranges as in :func:`mi_ntf.core.reference.reflectance`."""

__all__ = ["Array", "Color3", "Float", "Mask", "Place", "Ray", "Reflected", "UInt32", "Vector", "Vector3", "Visibility"]


class Visibility(Protocol):
    """Transmittance from shading points of a field to lights (:mod:`mi_ntf.infer.visibility`)."""

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask) -> Array:
        """Return the transmittance, a number or a colour, from the points `x` along the unit vectors `wi`.

        `distance` to the light, field units; `index`: row of the light table; lanes that are not `active` are unused.
        """
