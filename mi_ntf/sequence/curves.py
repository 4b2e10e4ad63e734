"""Values over frames, interpolated between key frames.

- ``smooth``, the default: ``monotone`` for numbers, ``catmull-rom`` for positions
- ``monotone``: cubic Hermite with the slopes of Fritsch and Butland (1984); it never leaves the range of the two keys
- ``catmull-rom``: cubic Hermite; the slope at a key is that of the parabola through it and its neighbours, so that
  paths are even but may swing out beyond their keys
- ``linear``: straight from key to key
- ``step``: each key's value until the next key
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..core import rotation
from ..core.errors import MiNtfError, shown

Array: TypeAlias = NDArray[np.float64]
INTERPOLATIONS = ("smooth", "monotone", "catmull-rom", "linear", "step")


@dataclass(frozen=True)
class Keys:
    """Curve through `values` (n, k) at the increasing key `frames` (n,). It is constant before and after the keys."""

    frames: Array
    values: Array
    interpolation: str

    def at(self, frame: float) -> Array:
        """Return the value at `frame`, (k,)."""
        frames, values = self.frames, self.values
        if frame <= frames[0] or len(frames) == 1:
            return np.asarray(values[0])
        if frame >= frames[-1]:
            return np.asarray(values[-1])
        i = int(np.searchsorted(frames, frame, side="right")) - 1
        before, after = values[i], values[i + 1]
        h = frames[i + 1] - frames[i]
        t = (frame - frames[i]) / h
        if self.interpolation == "step":
            return np.asarray(before)
        if self.interpolation == "linear":
            return np.asarray((1 - t) * before + t * after)
        monotone = self.interpolation == "monotone" or (self.interpolation == "smooth" and values.shape[1] == 1)
        slopes = _slopes(frames, values, monotone)
        p, q, step = h * slopes[i], h * slopes[i + 1], after - before
        return np.asarray(before + t * (p + t * (3 * step - 2 * p - q + t * (-2 * step + p + q))))


def _slopes(frames: Array, values: Array, monotone: bool) -> Array:
    """Return the curve's slope at each key, (n, k)."""
    h = np.diff(frames)[:, None]
    d = np.diff(values, axis=0) / h
    if len(frames) == 2:
        return np.concatenate([d, d])
    before, after, left, right = d[:-1], d[1:], h[:-1], h[1:]
    inner = (right * before + left * after) / (left + right)
    first, last = 2 * d[0] - inner[0], 2 * d[-1] - inner[-1]  # of the same parabolas
    if monotone:
        # Weighted harmonic mean; 0 at a key where the curve turns.
        u, v = 2 * right + left, right + 2 * left
        same = before * after > 0
        inner = np.where(same, (u + v) / (u / np.where(same, before, 1) + v / np.where(same, after, 1)), 0)
        first, last = (np.where(end * near > 0, np.sign(end) * np.minimum(np.abs(end), 3 * np.abs(near)), 0)
                       for end, near in ((first, d[0]), (last, d[-1])))
    return np.concatenate([first[None], inner, last[None]])


@dataclass(frozen=True)
class Circle:
    """The point `start`, turned about the `axis` through `centre` by the angle `degrees`."""

    start: Array
    centre: Array
    axis: Array
    degrees: Keys

    def at(self, frame: float) -> Array:
        """Return the point at `frame`, (3,)."""
        turn = rotation.about(self.axis, float(self.degrees.at(frame)[0]))
        return np.asarray(self.centre + turn @ (self.start - self.centre))


def track(value: object, size: int, name: str) -> Keys | Circle:
    """Return the curve of a value of a timeline.

    `value` is a constant, a table of ``keys`` and ``interpolation``, or for positions the table of a circle. `size` is
    its number of components, 1 or 3; `name` stands in errors. Raises MiNtfError for anything else.
    """
    if not isinstance(value, dict):
        return Keys(np.zeros(1), _components(value, size, name)[None], "step")
    if size == 3 and "degrees" in value:
        return _circle(value, name)
    check_names(value, ("keys", "interpolation"), name)
    interpolation = value.get("interpolation", "smooth")
    if interpolation not in INTERPOLATIONS:
        raise MiNtfError(f"{name}: interpolation is {shown(interpolation)}, expected one of "
                         f"{', '.join(INTERPOLATIONS)}")
    keys = value.get("keys")
    if not isinstance(keys, list) or not keys or not all(
            isinstance(k, list) and len(k) == 2 and is_number(k[0]) for k in keys):
        raise MiNtfError(f"{name}: keys is {shown(keys)}, expected [[frame, value], …]")
    frames = np.array([k[0] for k in keys], float)
    if (np.diff(frames) <= 0).any():
        raise MiNtfError(f"{name}: keys stand at the frames {shown(frames.tolist())}, which must increase")
    return Keys(frames, np.stack([_components(k[1], size, name) for k in keys]), interpolation)


def _components(value: object, size: int, name: str) -> Array:
    """Return a number or a vector of a timeline as (size,). Raises MiNtfError if it has another form."""
    parts = value if isinstance(value, list) else [value]
    if len(parts) != size or not all(is_number(p) for p in parts):
        raise MiNtfError(f"{name} is {shown(value)}, expected {'a number' if size == 1 else '[x, y, z]'}, "
                         "or { keys = [[frame, value], …] }")
    return np.array(parts, float)


def _circle(table: Mapping[str, object], name: str) -> Circle:
    check_names(table, ("start", "centre", "axis", "degrees"), name)
    for key in ("start", "centre", "axis"):
        if isinstance(table.get(key), dict):
            raise MiNtfError(f"{name}.{key} is {shown(table[key])}, expected [x, y, z]; degrees alone can have keys")
    start, centre, axis = (_components(table.get(key, default), 3, f"{name}.{key}") for key, default in
                           (("start", None), ("centre", None), ("axis", [0, 1, 0])))
    if not np.linalg.norm(axis) > 0:
        raise MiNtfError(f"{name}.axis is {table['axis']}, expected a vector other than 0")
    degrees = track(table["degrees"], 1, f"{name}.degrees")
    assert isinstance(degrees, Keys)  # a single number is no circle
    return Circle(start, centre, axis, degrees)


def is_number(value: object) -> TypeGuard[float]:
    """Return True if a value of a TOML file is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def check_names(table: Iterable[str], known: tuple[str, ...], name: str) -> None:
    """Raise MiNtfError where a table has other keys than `known`."""
    for key in table:
        if key not in known:
            raise MiNtfError(f"{name}: unknown key {shown(key)}, expected {', '.join(known)}")
