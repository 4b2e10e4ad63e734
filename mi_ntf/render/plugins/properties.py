"""The properties of the three plugins, read strictly: names, types and ranges are those of the docstrings, or one error
says which name, what was found there and what belongs there."""

import difflib
import math
from typing import NoReturn

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError

MEDIUM = ("filename", "to_world", "scale", "representation", "resolution", "sample_emitters")
INTEGRATOR = (
    "visibility", "samples", "light_samples", "environment_lights", "map_resolution", "map_source", "map_components",
    "map_memory", "map_file", "max_depth", "bounces", "unbiased", "aovs", "hide_emitters",
    "noise_threshold", "max_error", "time_budget", "frames", "timeout",
)
EMITTER = ("visibility", "sampling_weight")
"""Names that the plugins know; those that Mitsuba's own part of them reads are among them."""

_SIMPLE = {"Bool": "the boolean", "Integer": "the integer", "Float": "the number", "String": "the text"}


def is_medium(props) -> bool:
    """Return True if `props` are those of the medium ``nrf`` rather than the integrator's.

    Mitsuba has one constructor for a name and tells it no kind. A medium always has a field file, perhaps misspelt.
    """
    if props.id() in ("interior", "exterior"):  # from Python; in XML this name is not handed on
        return True
    return "filename" in (_nearest(name, (*INTEGRATOR, *MEDIUM)) for name in props.keys())


class Reader:
    """Values of `props` for the plugin that messages call `plugin`; `legal`: the names that it has.

    Raises MiNtfError where `props` holds another name. With `nested`, objects may have any, as Mitsuba makes them up.
    """

    def __init__(self, props, plugin: str, legal: tuple[str, ...], nested: bool = False):
        self._props, self._plugin = props, plugin
        for name in props.keys():
            if name not in legal and not (nested and self._kind(name) == "Object"):
                raise self._unknown(name, legal)

    def text(self, name: str, default: str) -> str:
        """A string."""
        return self._value(name, default, ("String",), "text")

    def choice(self, name: str, default: str, legal: tuple[str, ...]) -> str:
        """Return the text of a property, which must be one of the words `legal`."""
        expected = f"one of {', '.join(legal)}"
        value = self._value(name, default, ("String",), expected)
        return value if value in legal else self._refuse(name, expected)

    def flag(self, name: str, default: bool) -> bool:
        """A boolean."""
        return self._value(name, default, ("Bool",), "a boolean, true or false")

    def whole(self, name: str, default: int | None, low: int, high: int) -> int | None:
        """An integer in [`low`, `high`], or the default."""
        expected = f"an integer, {low} to {high}"
        value = self._value(name, default, ("Integer",), expected)
        return value if value is None or low <= value <= high else self._refuse(name, expected)

    def number(self, name: str, default: float, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number in [`low`, `high`]."""
        expected = "a finite number" + (f", {low:g} to {high:g}" if math.isfinite(low) else "")
        value = self._value(name, default, ("Integer", "Float"), expected)
        return float(value) if math.isfinite(value) and low <= value <= high else self._refuse(name, expected)

    def placement(self, name: str) -> np.ndarray:
        """(4, 4) float64, finite, of a transform; the identity where it is left out."""
        transform = self._value(name, mi.ScalarTransform4f(), ("Transform",), "a transform")
        matrix = np.array(transform.matrix, np.float64)
        return matrix if np.isfinite(matrix).all() else self._refuse(name, "finite numbers")

    def _value(self, name: str, default, kinds: tuple[str, ...], expected: str):
        if name not in self._props:
            return default
        kind = self._kind(name)
        if kind in kinds:
            return self._props[name]
        found = f"{_SIMPLE[kind]} {self._shown(name)}" if kind in _SIMPLE else f"of type {kind.lower()}"
        raise MiNtfError(f"{self._plugin}: {name} is {found}, expected {expected}")

    def _kind(self, name: str) -> str:
        return self._props.type(name).name

    def _shown(self, name: str) -> str:
        value = self._props[name]
        return f'"{value}"' if isinstance(value, str) else " ".join(str(value).split())

    def _refuse(self, name: str, expected: str) -> NoReturn:
        raise MiNtfError(f"{self._plugin}: {name} is {self._shown(name)}, expected {expected}")

    def _unknown(self, name: str, legal: tuple[str, ...]) -> MiNtfError:
        if self._kind(name) == "Object":
            return MiNtfError(f"{self._plugin}: it has no place for the nested {self._props[name].class_name()} "
                              f'"{name}"; remove it')
        meant = _nearest(name, legal)
        guess = f', did you mean "{meant}"?' if meant else "."
        if legal is INTEGRATOR and name in MEDIUM:
            guess = ', which belongs to the nrf medium (told by its "filename").'
        return MiNtfError(f'{self._plugin}: unknown property "{name}"{guess} It has {", ".join(legal)}')


def _nearest(name: str, legal: tuple[str, ...]) -> str | None:
    """The one of `legal` that `name` was probably meant to be."""
    return next(iter(difflib.get_close_matches(name, legal, n=1)), None)
