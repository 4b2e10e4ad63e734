"""Names of Dr.Jit's array types in annotations.

The arrays are those of whichever back end the caller uses, for which Dr.Jit's stubs have no common type: the names tell
readers the type, and type checkers take any.
"""

from typing import TypeAlias

from ..core.ops import Array, Vector

Float: TypeAlias = Array
UInt32: TypeAlias = Array
Mask: TypeAlias = Array
Place: TypeAlias = tuple[Array, ...]
"""Points as a density prepares them for lookups (:class:`mi_ntf.infer.grid.Density`)."""
Reflected: TypeAlias = tuple[Vector, Vector, Float, Float]
"""Normal, albedo, roughness and specular weight; ranges as in :func:`mi_ntf.core.reference.reflectance`."""

__all__ = ["Array", "Float", "Mask", "Place", "Reflected", "UInt32", "Vector"]


class Visibility(Protocol):
    """Transmittance from shading points of a field to lights (:mod:`mi_ntf.infer.visibility`)."""

    def tau(self, x: Triple, wi: Triple, distance: Float, index: UInt32, active: Bool) -> Array:
        """Return the transmittance, a number or a colour, from the points `x` along the unit vectors `wi`.

        `distance` to the light, field units; `index`: row of the light table; lanes that are not `active` are unused.
        """
