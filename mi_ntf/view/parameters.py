"""Scene parameters by the object that they belong to, set so that no kernel is compiled for a new value."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


class Parameters:
    """The traversed parameters of `scene`."""

    def __init__(self, scene):
        self._all = mi.traverse(scene)
        self._changed = False

    def get(self, node, name: str) -> Any:
        """Parameter `name` of the object `node`."""
        return self._all[self._key(node, name)]

    def has(self, node, name: str) -> bool:
        return any(self._of(key, node, name) for key in self._all.properties)

    def set(self, node, name: str, value) -> None:
        """`value`: numbers or an array, in the form that the parameter has. It counts from :meth:`update` on."""
        key = self._key(node, name)
        old = self._all[key]
        if isinstance(old, mi.AffineTransform4f):
            matrix = mi.Matrix4f(np.asarray(value, np.float64).tolist())
            dr.make_opaque(matrix)  # a number that Python knows would be compiled into kernels
            new = mi.AffineTransform4f(matrix)
        else:
            new = type(old)(value) if np.ndim(value) == 0 else type(old)(np.asarray(value).tolist())
            if dr.is_jit_v(new):
                dr.make_opaque(new)
        self._all[key] = new
        self._changed = True

    def update(self) -> None:
        """Tell the objects what was set."""
        if self._changed:
            self._all.update()
            self._changed = False

    def _key(self, node, name: str) -> str:
        for key in self._all.properties:
            if self._of(key, node, name):
                return key
        raise KeyError(f"{node.class_name()} has no parameter {name}")

    def _of(self, key: str, node, name: str) -> bool:
        """Whether `key` is the parameter `name` of `node`; names with a dot belong to an object inside it."""
        if not (key == name or key.endswith("." + name)):
            return False
        owner = self._all.properties[key][2]
        for _ in range(name.count(".")):
            owner = self._all.hierarchy[owner][0] if owner in self._all.hierarchy else None
        return owner is node


def numbers(value) -> np.ndarray:
    """Any of Mitsuba's numbers, vectors (n,) and matrices (4, 4), float64."""
    if isinstance(value, mi.AffineTransform4f):
        return np.array(value.matrix, np.float64).reshape(4, 4)
    return np.array(value, np.float64).ravel()
