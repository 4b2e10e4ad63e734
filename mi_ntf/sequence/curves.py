"""Values over frames, given at key frames.

    smooth       the default: ``monotone`` for numbers, ``catmull-rom`` for positions
    monotone     cubic Hermite, slopes of Fritsch and Butland (1984): never beyond the keys on either side
    catmull-rom  cubic Hermite, slope at a key that of the parabola through it and its neighbours: even paths, which may
                 swing out beyond their keys
    linear       straight from key to key
    step         each key's value until the next
"""

import numpy as np

from ..core.errors import MiNtfError, shown

INTERPOLATIONS = ("smooth", "monotone", "catmull-rom", "linear", "step")


def at(frame: float, frames: np.ndarray, values: np.ndarray, interpolation: str) -> np.ndarray:
    """The curve through `values` (n, k) at the key `frames` (n,), increasing, at `frame`: (k,). Before the first key
    and after the last it is constant."""
    frames, values = np.asarray(frames, float), np.asarray(values, float)
    if frame <= frames[0] or len(frames) == 1:
        return values[0]
    if frame >= frames[-1]:
        return values[-1]
    if interpolation == "smooth":
        interpolation = "monotone" if values.shape[1] == 1 else "catmull-rom"
    i = int(np.searchsorted(frames, frame, side="right")) - 1
    if interpolation == "step":
        return values[i]
    h = frames[i + 1] - frames[i]
    t = (frame - frames[i]) / h
    a, b = values[i], values[i + 1]
    if interpolation == "linear":
        return (1 - t) * a + t * b
    slopes = _slopes(frames, values, interpolation == "monotone")
    p, q = h * slopes[i], h * slopes[i + 1]
    return a + t * (p + t * (3 * (b - a) - 2 * p - q + t * (2 * (a - b) + p + q)))


def _slopes(frames: np.ndarray, values: np.ndarray, monotone: bool) -> np.ndarray:
    """The curve's slope at each key, (n, k)."""
    h = np.diff(frames)[:, None]
    d = np.diff(values, axis=0) / h
    if len(frames) == 2:
        return np.concatenate([d, d])
    before, after, left, right = d[:-1], d[1:], h[:-1], h[1:]
    inner = (right * before + left * after) / (left + right)
    first, last = 2 * d[0] - inner[0], 2 * d[-1] - inner[-1]  # of the same parabolas
    if monotone:
        # The harmonic mean, weighted; none where the curve turns.
        u, v = 2 * right + left, right + 2 * left
        same = before * after > 0
        inner = np.where(same, (u + v) / (u / np.where(same, before, 1) + v / np.where(same, after, 1)), 0)
        first, last = (np.where(end * near > 0, np.sign(end) * np.minimum(np.abs(end), 3 * np.abs(near)), 0)
                       for end, near in ((first, d[0]), (last, d[-1])))
    return np.concatenate([first[None], inner, last[None]])


def turned(point: np.ndarray, centre: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray:
    """`point` turned about the `axis` through `centre`, counter-clockwise seen from where the axis points to."""
    axis = axis / np.linalg.norm(axis)
    arm, angle = point - centre, np.radians(degrees)
    along = axis * (axis @ arm)
    return centre + along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(axis, arm)


class Track:
    """What a table of a timeline says of one value: a constant; ``keys``, a list of [frame, value], with an
    ``interpolation``; for positions also a ``start``, turned about the ``axis`` through ``centre`` by ``degrees``, a
    number track.

    `size`: numbers of the value, 1 or 3. `name`: what it is called in errors. Raises MiNtfError.
    """

    def __init__(self, said, size: int, name: str):
        self.name, self.size = name, size
        self._circle = None
        if isinstance(said, dict) and size == 3 and "degrees" in said:
            self._circle = self._read_circle(said)
        elif isinstance(said, dict):
            only(said, ("keys", "interpolation"), name)
            self._frames, self._values = self._read_keys(said.get("keys"))
            self._interpolation = said.get("interpolation", "smooth")
            if self._interpolation not in INTERPOLATIONS:
                raise MiNtfError(f"{name}: interpolation is {shown(self._interpolation)}, expected one of "
                                 f"{', '.join(INTERPOLATIONS)}")
        else:
            self._frames, self._values, self._interpolation = np.zeros(1), self._value(said)[None], "step"

    def at(self, frame: float) -> np.ndarray:
        """The value at `frame`, (size,) float64."""
        if self._circle:
            start, centre, axis, degrees = self._circle
            return turned(start, centre, axis, degrees.at(frame)[0])
        return at(frame, self._frames, self._values, self._interpolation)

    def _value(self, said) -> np.ndarray:
        parts = said if isinstance(said, list) else [said]
        if len(parts) != self.size or not all(is_number(p) for p in parts):
            raise MiNtfError(f"{self.name} is {shown(said)}, expected {'a number' if self.size == 1 else '[x, y, z]'}, "
                             "or { keys = [[frame, value], …] }")
        return np.array(parts, float)

    def _read_keys(self, keys):
        if not isinstance(keys, list) or not keys or not all(
                isinstance(k, list) and len(k) == 2 and is_number(k[0]) for k in keys):
            raise MiNtfError(f"{self.name}: keys is {shown(keys)}, expected [[frame, value], …]")
        frames = np.array([k[0] for k in keys], float)
        if (np.diff(frames) <= 0).any():
            raise MiNtfError(f"{self.name}: keys stand at the frames {shown(frames.tolist())}, which must increase")
        return frames, np.stack([self._value(k[1]) for k in keys])

    def _read_circle(self, said):
        only(said, ("start", "centre", "axis", "degrees"), self.name)
        start, centre, axis = (
            Track(said.get(key, default), 3, f"{self.name}.{key}").at(0)
            for key, default in (("start", None), ("centre", None), ("axis", [0, 1, 0])))
        if not np.linalg.norm(axis) > 0:
            raise MiNtfError(f"{self.name}.axis is {said['axis']}, expected a vector other than 0")
        return start, centre, axis, Track(said["degrees"], 1, f"{self.name}.degrees")


def is_number(value) -> bool:
    """Whether a value of a TOML file is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def only(said: dict, known: tuple, name: str) -> None:
    """Raise MiNtfError where a table has other keys than `known`."""
    for key in said:
        if key not in known:
            raise MiNtfError(f"{name}: unknown key {shown(key)}, expected {', '.join(known)}")

