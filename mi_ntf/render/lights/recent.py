"""Results that every trial and every frame asks for again."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

KEPT = 8


class Recent(dict):
    """Cache of the `kept` results that were asked for last, by their inputs."""

    def __init__(self, kept: int = KEPT):
        super().__init__()
        self._kept = kept

    def of(self, key, make: Callable[[], Any]):
        """Return the result of `key`; it is `make()` if none is kept."""
        found = self.pop(key) if key in self else make()
        while len(self) >= self._kept:
            del self[next(iter(self))]
        self[key] = found
        return found


class Version:
    """The parameters of Mitsuba objects at one moment, as a key: equal to another while none has been assigned a new
    value.

    Arrays are compared by their Dr.Jit variables, since reading all texels of a large map takes long. A copy of each
    array is kept, so that no other variable gets its index meanwhile. Neither the objects nor anything that carries
    gradients is kept, since these would outlive their scene.

    owners    type of the objects, given or nested, whose parameters count
    attached  whether a parameter carries gradients
    """

    def __init__(self, *objects, owners: type = object):
        values = [value for parameters in map(mi.traverse, objects) for name, value in parameters
                  if isinstance(parameters.properties[name][2], owners)]
        self.attached = any(dr.grad_enabled(value) for value in values)
        # Copies: an object's own array, held by reference, would be written to in place.
        self._arrays = [type(value)(dr.detach(value)) for value in values if _is_large(value)]
        self._key = (*(o.class_name() for o in objects), *map(_identity, values))

    def __eq__(self, other) -> bool:
        return isinstance(other, Version) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def once(self, kept: Recent, make: Callable[[], Any], *more):
        """Return the result in `kept` for this version and the inputs `more`; it is `make()` if there is none."""
        return make() if self.attached else kept.of((self, *more), make)


def _is_large(value) -> bool:
    """Return True if `value` is a tensor or an array of more than one number."""
    return dr.is_tensor_v(value) or (dr.is_array_v(value) and dr.depth_v(value) == 1 and dr.width(value) > 1)


def _identity(value) -> tuple | bytes:
    if not _is_large(value):
        return np.array(dr.detach(getattr(value, "matrix", value))).tobytes()
    array = value.array if dr.is_tensor_v(value) else value
    return dr.shape(value), array.index
