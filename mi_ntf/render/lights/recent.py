"""Results that every trial and every frame asks for again."""

from collections.abc import Callable
from typing import Any

KEPT = 8


class Recent(dict):
    """The `KEPT` results that were asked for last, by what they were made of."""

    def of(self, key, make: Callable[[], Any]):
        """That of `key`, from `make()` if it is not kept."""
        found = self.pop(key) if key in self else make()
        while len(self) >= KEPT:
            del self[next(iter(self))]
        self[key] = found
        return found
