"""Types of Dr.Jit arrays and of the values made of them.

The classes exist once a variant is set, and their stubs lack the operators of vectors. A type checker therefore takes
every array for ``Any``; the names tell a reader which array is meant.
"""

from typing import Any, TypeAlias

Array: TypeAlias = Any
"""A Dr.Jit array, a vector of arrays, or a structure of them."""
Float: TypeAlias = Array
UInt32: TypeAlias = Array
Bool: TypeAlias = Array
Vector3: TypeAlias = Array
"""``mi.Vector3f``, ``mi.Point3f`` or a normal."""
Color3: TypeAlias = Array
Ray: TypeAlias = Array
Triple: TypeAlias = tuple[Float, Float, Float]
"""Components x, y, z of points or directions in field coordinates, or linear RGB."""
