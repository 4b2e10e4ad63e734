"""Values of JSON from a file, which may have any form."""

import math
from typing import Any, TypeAlias, TypeVar

from .errors import shown

T = TypeVar("T")
Json: TypeAlias = dict[str, Any]


def member(data: Json, key: str, kind: type[T]) -> T:
    """Return ``data[key]``; raise ValueError if it is missing or of another type than `kind`."""
    if key not in data:
        raise ValueError(f"{key} is missing")
    value = data[key]
    if not isinstance(value, kind):
        raise ValueError(f"{key} is {shown(value)}, expected {_JSON[kind]}")
    return value


def whole(value: object, name: str, low: int, high: int = 1 << 31) -> int:
    """Return an integer from `low` to `high`; raise ValueError that begins with `name` if it is none."""
    if type(value) is not int or not low <= value <= high:  # a bool is an int too
        raise ValueError(f"{name} is {shown(value)}, expected an integer, {low} to {high}")
    return value


def number(value: object, name: str, above: float = -math.inf) -> float:
    """Return a finite number larger than `above`; raise ValueError that begins with `name` if it is none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not above < value or not abs(value) < 1e30:
        raise ValueError(f"{name} is {shown(value)}, expected a finite number" + (" above 0" if above == 0 else ""))
    return float(value)


_JSON = {dict: "an object", list: "a list", str: "text", bool: "true or false"}
