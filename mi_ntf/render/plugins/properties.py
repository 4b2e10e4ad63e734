"""Strict reading of the plugins' properties.

Names, types and ranges are those of the plugins' docstrings. An error names the property, its value and the values that
are allowed.
"""

from __future__ import annotations

import difflib
import math
from typing import NoReturn, TypeVar, cast

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError

MEDIUM = ("filename", "to_world", "scale", "representation", "resolution", "shadow_catcher", "sample_emitters")
INTEGRATOR = (
    "visibility", "samples", "light_samples", "environment_lights", "map_resolution", "map_source", "map_components",
    "map_memory", "map_file", "max_depth", "rr_depth", "bounces", "unbiased", "shadow_gradients", "aovs",
    "hide_emitters", "noise_threshold", "max_error", "time_budget", "frames", "timeout",
)
EMITTER = ("visibility", "sampling_weight")
"""Names of the properties, including those that Mitsuba's base classes read."""

T = TypeVar("T")
_SIMPLE = {"Bool": "the boolean", "Integer": "the integer", "Float": "the number", "String": "the text"}


def is_medium(props: mi.Properties) -> bool:
    """Return True if `props` are those of the medium ``nrf`` rather than the integrator's.

    Mitsuba has one constructor for a name, whatever the kind of plugin. A medium always has a field file, perhaps
    misspelt.
    """
    if props.id() in ("interior", "exterior"):  # from Python; in XML this name is not handed on
        return True
    return "filename" in (_nearest(name, (*INTEGRATOR, *MEDIUM)) for name in props.keys())


class Reader:
    """Values of the properties of a plugin, which messages call `plugin`.

    Raises MiNtfError for names that are not in `legal`. If `nested`, there may be nested objects of any name.
    """

    def __init__(self, props: mi.Properties, plugin: str, legal: tuple[str, ...], nested: bool = False) -> None:
        self._props, self._plugin = props, plugin
        for name in props.keys():
            if name not in legal and not (nested and self._kind(name) == "Object"):
                raise self._unknown(name, legal)

    def text(self, name: str, default: str) -> str:
        """Return a string."""
        return self._value(name, default, ("String",), "text")

    def choice(self, name: str, default: str, legal: tuple[str, ...]) -> str:
        """Return the text of a property, which must be one of the words `legal`."""
        expected = f"one of {', '.join(legal)}"
        value = self._value(name, default, ("String",), expected)
        return value if value in legal else self._refuse(name, expected)

    def flag(self, name: str, default: bool) -> bool:
        """Return a boolean."""
        return self._value(name, default, ("Bool",), "a boolean, true or false")

    def whole(self, name: str, default: int, low: int, high: int) -> int:
        """Return an integer in [`low`, `high`], or the default, which need not lie there."""
        expected = "an integer, " + ("" if low <= default <= high else f"{default} or ") + f"{low} to {high}"
        value = self._value(name, default, ("Integer",), expected)
        return value if value == default or low <= value <= high else self._refuse(name, expected)

    def number(self, name: str, default: float, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a finite number in [`low`, `high`]."""
        expected = "a finite number" + (f", {low:g} to {high:g}" if math.isfinite(low) else "")
        value = self._value(name, default, ("Integer", "Float"), expected)
        return float(value) if math.isfinite(value) and low <= value <= high else self._refuse(name, expected)

    def placement(self, name: str) -> np.ndarray:
        """Return the (4, 4) finite float64 matrix of a transform, by default the identity."""
        transform = self._value(name, mi.ScalarTransform4f(), ("Transform",), "a transform")
        matrix = np.array(transform.matrix, np.float64)
        return matrix if np.isfinite(matrix).all() else self._refuse(name, "finite numbers")

    def _value(self, name: str, default: T, kinds: tuple[str, ...], expected: str) -> T:
        if name not in self._props:
            return default
        kind = self._kind(name)
        if kind in kinds:
            return cast(T, self._props[name])
        actual = f"{_SIMPLE[kind]} {self._shown(name)}" if kind in _SIMPLE else f"of type {kind.lower()}"
        raise MiNtfError(f"{self._plugin}: {name} is {actual}, expected {expected}")

    def _kind(self, name: str) -> str:
        return self._props.type(name).name

    def _shown(self, name: str) -> str:
        value = self._props[name]
        return f'"{value}"' if isinstance(value, str) else " ".join(str(value).split())

    def _refuse(self, name: str, expected: str) -> NoReturn:
        raise MiNtfError(f"{self._plugin}: {name} is {self._shown(name)}, expected {expected}")

    def _unknown(self, name: str, legal: tuple[str, ...]) -> MiNtfError:
        if self._kind(name) == "Object":
            nested = cast(mi.Object, self._props[name])
            return MiNtfError(f"{self._plugin}: it has no place for the nested {nested.class_name()} "
                              f'"{name}"; remove it')
        meant = _nearest(name, legal)
        guess = f', did you mean "{meant}"?' if meant else "."
        if legal is INTEGRATOR and name in MEDIUM:
            guess = ', which belongs to the nrf medium (told by its "filename").'
        return MiNtfError(f'{self._plugin}: unknown property "{name}"{guess} It has {", ".join(legal)}')


def _nearest(name: str, legal: tuple[str, ...]) -> str | None:
    """Return the name of `legal` that `name` probably misspells."""
    return next(iter(difflib.get_close_matches(name, legal, n=1)), None)
