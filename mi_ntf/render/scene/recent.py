"""Cache of results that every trial and every frame requests again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer.types import Array
from .traversal import traverse

SIZE = 8
Result = TypeVar("Result")


class Recent(dict[Hashable, Result], Generic[Result]):
    """Cache of the `size` results that were requested last, by their inputs."""

    def __init__(self, size: int = SIZE) -> None:
        super().__init__()
        self._size = size

    def of(self, key: Hashable, make: Callable[[], Result]) -> Result:
        """Return the result of `key`; call `make` if it is not in the cache."""
        result = self.pop(key) if key in self else make()
        while len(self) >= self._size:
            del self[next(iter(self))]
        self[key] = result
        return result


class Version:
    """Key that tells the parameters of Mitsuba objects at one moment from other values.

    Two keys are equal as long as no parameter has been assigned a new value. Arrays are compared by the index of their
    Dr.Jit variables, since reading all texels of a large map takes long. A copy of each array is stored, so that no
    other variable gets its index meanwhile. Neither the objects nor anything that carries gradients is stored, since
    these would outlive their scene.

    `owners`: type of the objects, `objects` themselves or nested ones, whose parameters count; `attached`: True if a
    parameter carries gradients.
    """

    def __init__(self, *objects: mi.Object, owners: type = object) -> None:
        values = [value for parameters in map(traverse, objects) for name, value in parameters
                  if isinstance(parameters.properties[name][2], owners)]
        self.attached = any(dr.grad_enabled(value) for value in values)
        # Copies, since an object's own array, held by reference, would be written to in place.
        self._arrays = [type(value)(dr.detach(value)) for value in values if _is_large(value)]
        self._key = (*(o.class_name() for o in objects), *map(_identity, values))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Version) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def once(self, cache: Recent[Result], make: Callable[[], Result], *inputs: Hashable) -> Result:
        """Return the result for this version and further `inputs` from `cache`; call `make` if it is not there.

        Nothing is cached if a parameter carries gradients.
        """
        return make() if self.attached else cache.of((self, *inputs), make)


def _is_large(value: object) -> bool:
    """Return True if `value` is a tensor or an array of more than one number."""
    return bool(dr.is_tensor_v(value) or (dr.is_array_v(value) and dr.depth_v(value) == 1 and dr.width(value) > 1))


def _identity(value: Array) -> Hashable:
    if not _is_large(value):
        return np.array(dr.detach(getattr(value, "matrix", value))).tobytes()
    array = value.array if dr.is_tensor_v(value) else value
    return dr.shape(value), array.index
