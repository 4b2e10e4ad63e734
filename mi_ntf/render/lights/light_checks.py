"""Checks of emitters: kinds that cannot be sampled, and non-finite or negative values, are refused."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from .environment import name
from .recent import Recent, Version

_checked = Recent(2)


def check(emitter, kind: str, drawn: bool = False) -> None:
    """Raises MiNtfError where `emitter` has NaN or infinite parameters, texels among them; where it is to be drawn at
    random and Mitsuba's sampling would not find it. Negative light is light: it subtracts."""
    called = name(emitter, kind)
    if kind == "timed_sunsky":
        raise MiNtfError(
            f"{called}: Mitsuba cannot sample timed_sunsky in a loop over shading points; use sunsky at one moment, or "
            "an envmap of the average over several"
        )
    if kind == "envmap":  # its texels take long to read
        Version(emitter).once(_checked, lambda: _check(emitter, kind, drawn), drawn)
    else:
        _check(emitter, kind, drawn)


def _check(emitter, kind: str, drawn: bool) -> None:
    """Raise MiNtfError if a parameter has values that :func:`check` refuses."""
    called = name(emitter, kind)
    for key, value in mi.traverse(emitter):
        numbers = _numbers(value)
        if numbers is None:
            continue
        texels = key.endswith("data") and numbers.ndim == 3
        if texels and kind == "envmap":
            numbers = numbers[:, 1:-1]  # Mitsuba repeats a column on either side
        if not np.isfinite(numbers.sum(dtype=np.float64)):
            _refuse(called, key, numbers, ~np.isfinite(numbers), "NaN or infinite", texels)
        if drawn and texels and kind == "envmap" and numbers.min() < 0:
            _refuse(called, key, numbers, numbers < 0, "negative, which Mitsuba's sampling never finds", texels)


def _numbers(value):
    """A parameter as an array; None where it has no floating-point numbers."""
    if not dr.is_array_v(value):
        value = getattr(value, "matrix", value)  # of transforms; arrays take any such name for a swizzle
    numbers = np.asarray(dr.detach(value) if dr.is_array_v(value) else value)
    return numbers if numbers.dtype.kind == "f" else None


def _refuse(called: str, key: str, numbers, wrong, what: str, texels: bool) -> None:
    """Raises the error that names how many and the first."""
    if texels:
        wrong = wrong.any(axis=-1)
    count, first = int(wrong.sum()), tuple(int(i) for i in np.argwhere(wrong)[0])
    seen = numbers[first].tolist() if first else float(numbers)
    place = f"row {first[0]}, column {first[1]}" if texels else f"entry {', '.join(map(str, first)) or 0}"
    noun = "texels" if texels else "numbers"
    raise MiNtfError(
        f"{called}: {count} {noun} of {key} are {what}, the first at {place} ({seen}); replace them before rendering"
    )
