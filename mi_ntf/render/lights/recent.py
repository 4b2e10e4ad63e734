"""Results that every trial and every frame asks for again."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

KEPT = 8


class Recent(dict):
    """The `kept` results that were asked for last, by what they were made of."""

    def __init__(self, kept: int = KEPT):
        super().__init__()
        self._kept = kept

    def of(self, key, make: Callable[[], Any]):
        """Return that of `key`, from `make()` if it is not kept."""
        found = self.pop(key) if key in self else make()
        while len(self) >= self._kept:
            del self[next(iter(self))]
        self[key] = found
        return found


class Version:
    """An emitter at one moment, as a key: equal to another while no parameter has been assigned a new value.

    Arrays are compared by their Dr.Jit variables, not by their contents: a map of 4096 × 2048 texels takes 0.4 s to
    read. They are kept, so that no other variable gets the same index meanwhile."""

    def __init__(self, emitter):
        self._emitter = emitter
        # Copies: the emitter's own tensor, held by reference, would be written to in place.
        self._values = [type(value)(value) if dr.is_tensor_v(value) else value for _, value in mi.traverse(emitter)]
        self._key = (id(emitter), *map(_identity, self._values))

    def __eq__(self, other) -> bool:
        return isinstance(other, Version) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def _identity(value) -> tuple | bytes:
    if dr.is_tensor_v(value):
        return value.shape, value.array.index, value.array.index_ad
    return np.array(dr.detach(getattr(value, "matrix", value))).tobytes()
