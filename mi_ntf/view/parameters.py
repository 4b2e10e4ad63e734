"""Scene parameters by the object that they belong to, set so that no kernel is compiled for a new value."""

from __future__ import annotations

from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..render.scene.traversal import traverse

Value: TypeAlias = Any
"""A parameter's value: a number, vector, colour or transform of the current variant."""


class Parameters:
    """The traversed parameters of `scene`."""

    def __init__(self, scene: mi.Scene) -> None:
        self._all = traverse(scene)
        self._changed = False

    def get(self, node: mi.Object, name: str) -> Value:
        """Return the parameter `name` of the object `node`."""
        return self._all[self._key(node, name)]

    def has(self, node: mi.Object, name: str) -> bool:
        """Return True if the object `node` has the parameter `name`."""
        return any(self._belongs(key, node, name) for key in self._all.properties)

    def set(self, node: mi.Object, name: str, value: ArrayLike) -> None:
        """Set a parameter to numbers, in the form that it has. The scene uses them after :meth:`update`."""
        key = self._key(node, name)
        old = self._all[key]
        if isinstance(old, mi.AffineTransform4f):
            matrix = mi.Matrix4f(np.asarray(value, np.float64).tolist())
            dr.make_opaque(matrix)  # literals would be compiled into kernels
            new = mi.AffineTransform4f(matrix)
        else:
            new = type(old)(value) if np.ndim(value) == 0 else type(old)(np.asarray(value).tolist())
            if dr.is_jit_v(new):
                dr.make_opaque(new)
        self._all[key] = new
        self._changed = True

    def update(self) -> None:
        """Let the objects take the values that were set."""
        if self._changed:
            self._all.update()
            self._changed = False

    def _key(self, node: mi.Object, name: str) -> str:
        for key in self._all.properties:
            if self._belongs(key, node, name):
                return str(key)
        raise KeyError(f"{node.class_name()} has no parameter {name}")

    def _belongs(self, key: str, node: mi.Object, name: str) -> bool:
        """Return True if `key` is the parameter `name` of `node`. A dotted name belongs to an object inside of it."""
        if not (key == name or key.endswith("." + name)):
            return False
        owner = self._all.properties[key][2]
        for _ in range(name.count(".")):
            owner = self._all.hierarchy[owner][0] if owner in self._all.hierarchy else None
        return owner is node


def numbers(value: Value) -> NDArray[np.float64]:
    """Return any of Mitsuba's numbers, vectors as (n,) and matrices as (4, 4)."""
    if isinstance(value, mi.AffineTransform4f):
        return np.array(value.matrix, np.float64).reshape(4, 4)
    return np.array(value, np.float64).ravel()
