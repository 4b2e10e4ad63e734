"""Checks of emitters, which refuse kinds that cannot be sampled and non-finite or negative values."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ..scene.recent import Recent, Version
from .environment import name

_checked: Recent[None] = Recent(2)


def check(emitter: mi.Emitter, kind: str, sampled: bool = False) -> None:
    """Raise MiNtfError if `emitter` has parameters, texels among them, that are NaN or infinite.

    Emitters that are `sampled` at random are refused, too, if Mitsuba's sampling does not find all of their light.
    Negative light is allowed and subtracts.
    """
    if kind == "timed_sunsky":
        raise MiNtfError(
            f"{name(emitter, kind)}: Mitsuba cannot sample timed_sunsky in a loop over shading points; use sunsky at "
            "one moment, or an envmap of the average over several"
        )
    if kind == "envmap":  # its texels take long to read
        Version(emitter).once(_checked, lambda: _check(emitter, kind, sampled), sampled)
    else:
        _check(emitter, kind, sampled)


def _check(emitter: mi.Emitter, kind: str, sampled: bool) -> None:
    """Raise MiNtfError if a parameter has values that :func:`check` refuses."""
    label = name(emitter, kind)
    for key, value in mi.traverse(emitter):
        numbers = _numbers(value)
        if numbers is None:
            continue
        texels = key.endswith("data") and numbers.ndim == 3
        if texels and kind == "envmap":
            numbers = numbers[:, 1:-1]  # Mitsuba repeats a column on either side
        if not np.isfinite(numbers.sum(dtype=np.float64)):
            _refuse(label, key, numbers, ~np.isfinite(numbers), "NaN or infinite", texels)
        if sampled and texels and kind == "envmap" and numbers.min() < 0:
            _refuse(label, key, numbers, numbers < 0, "negative, which Mitsuba's sampling never finds", texels)


def _numbers(value: object) -> np.ndarray | None:
    """Return a parameter as an array, or None if it has no floating-point numbers."""
    if not dr.is_array_v(value):
        value = getattr(value, "matrix", value)  # of transforms; arrays would take the name for a swizzle
    numbers = np.asarray(dr.detach(value) if dr.is_array_v(value) else value)
    return numbers if numbers.dtype.kind == "f" else None


def _refuse(label: str, key: str, numbers: np.ndarray, wrong: np.ndarray, fault: str, texels: bool) -> None:
    """Raise the error that tells how many numbers are `wrong` and where the first of them is."""
    entries = np.argwhere(wrong.any(axis=-1) if texels else wrong)
    count, first = len(entries), tuple(int(i) for i in entries[0])
    value = numbers[first].tolist() if first else float(numbers)
    place = f"row {first[0]}, column {first[1]}" if texels else f"entry {', '.join(map(str, first)) or 0}"
    noun = "texels" if texels else "numbers"
    raise MiNtfError(
        f"{label}: {count} {noun} of {key} are {fault}, the first at {place} ({value}); replace them before rendering"
    )
