"""Elementary functions by name, so that one formula serves NumPy, Dr.Jit and PyTorch.

A formula of :mod:`mi_ntf.core` takes a namespace of functions as its first argument. This module is the namespace of
NumPy, the float64 oracle; ``infer`` and ``train`` each hold theirs.
"""

from collections.abc import Iterator
from types import ModuleType
from typing import Any, Protocol, TypeAlias

import numpy as np

Array: TypeAlias = Any
"""Array of NumPy, Dr.Jit or PyTorch, or a number. No static type covers the arithmetic of all of them."""
Tensors: TypeAlias = dict[str, np.ndarray]
"""Name → array of a field file."""
Ops: TypeAlias = ModuleType
"""Module with ``sqrt exp log sin cos abs maximum minimum where`` of one framework."""


class Vector(Protocol):
    """Components of a point, direction or colour: a tuple of arrays, or one Dr.Jit array of them."""

    def __getitem__(self, index: int, /) -> Array:
        """Return a component."""

    def __iter__(self) -> Iterator[Array]:
        """Iterate over the components."""

    def __len__(self) -> int:
        """Return the number of components."""


sqrt, exp, log, sin, cos, abs = np.sqrt, np.exp, np.log, np.sin, np.cos, np.abs
maximum, minimum, where = np.maximum, np.minimum, np.where


def dot(a: Vector, b: Vector) -> Array:
    """Return the inner product of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> tuple[Array, Array, Array]:
    """Return the vector product of two 3-vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def normalize(ops: Ops, a: Vector, tiny: float = 1e-20) -> tuple[Array, Array, Array]:
    """Return the 3-vector `a` over its length; a zero vector stays zero and has finite gradients."""
    scale = 1 / ops.sqrt(ops.maximum(dot(a, a), tiny))
    return a[0] * scale, a[1] * scale, a[2] * scale
