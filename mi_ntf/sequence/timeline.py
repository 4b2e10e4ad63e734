"""Frames from a timeline: a TOML file that says what changes over them.

    frames = 120                     # how many; numbers count from 0
    fps = 24                         # of the film (default: 24)

    [parameters]                     # $names of the scene, as -D gives them
    visibility = "transmittance_map"
    power = { keys = [[0, 1.0], [60, 3.0], [119, 1.0]], interpolation = "smooth" }

    [camera]                         # the sensor: `origin` with `target`, `up`, `fov`
    origin = { keys = [[0, [-1, 1.4, 3.7]], [60, [0, 2, 3.5]], [119, [1, 1.4, 3.7]]] }
    target = [0.1, 0.8, 0]

    [lights.point]                   # an emitter by its id, or by its plugin where there is one of it
    position = { start = [2, 3, 3], centre = [0, 0, 0], axis = [0, 1, 0], degrees = { keys = [[0, 0], [120, 360]] } }

    [environment]
    degrees = { keys = [[0, 0], [120, 360]], interpolation = "linear" }
    axis = [0, 1, 0]

Interpolations: :mod:`mi_ntf.sequence.curves`. All lengths are scene lengths, angles degrees.
"""

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..core.errors import MiNtfError, shown
from .curves import Track, is_number, only

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MOST = 10**7
"""Frames."""
CAMERA = {"origin": 3, "target": 3, "up": 3, "fov": 1}
LIGHT = {"position": 3, "target": 3}
"""What can be said of each, and of how many numbers it is."""


@dataclass(frozen=True)
class Frame:
    """What frame `number` has of its own: `parameters`, values of $names as text; `camera`, `lights` (by name) and
    `environment` as in a timeline, with this frame's numbers."""

    number: int
    parameters: dict[str, str] = field(default_factory=dict)
    camera: dict[str, Any] = field(default_factory=dict)
    lights: dict[str, dict[str, Any]] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)

    def told(self) -> dict[str, Any]:
        """What is not empty, without the number, as plain data."""
        return {key: value for key, value in asdict(self).items() if value and key != "number"}


@dataclass(frozen=True)
class Timeline:
    """All `frames`, in order, and how many `fps` of them are shown a second."""

    frames: list[Frame]
    fps: float = 24.0


def read(path: str | Path, fixed: dict[str, str] | None = None) -> Timeline:
    """The frames of the TOML file `path`; `fixed`: values of $names that go before those of the file. Raises MiNtfError
    that names what is wrong in it."""
    try:
        said = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise MiNtfError(f"timeline {path} cannot be read ({error.strerror}); give a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise MiNtfError(f"timeline {path} is no TOML file: {error}") from None
    try:
        return of(said, fixed or {})
    except MiNtfError as error:
        raise MiNtfError(f"timeline {path}: {error}") from None


def of(said: dict[str, Any], fixed: dict[str, str]) -> Timeline:
    """:func:`read`, of what is in the file."""
    only(said, ("frames", "fps", "parameters", "camera", "lights", "environment"), "top level")
    count, fps = said.get("frames"), said.get("fps", 24)
    if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MOST:
        raise MiNtfError(f"frames is {shown(count)}, expected a whole number from 1 to {MOST}")
    if not is_number(fps) or not 0 < fps <= 1000:
        raise MiNtfError(f"fps is {shown(fps)}, expected a number above 0, at most 1000")
    parameters = {name: _parameter(value, f"parameters.{name}") for name, value in _table(said, "parameters").items()}
    parameters |= {name: (lambda _, value=value: value) for name, value in fixed.items()}
    camera = _tracks(_table(said, "camera"), CAMERA, "camera")
    if ("origin" in camera) != ("target" in camera) or ("up" in camera and "origin" not in camera):
        raise MiNtfError("camera needs both origin and target, or neither of them and no up")
    lights = {name: _tracks(_table(_table(said, "lights"), name, "lights."), LIGHT, f"lights.{name}")
              for name in _table(said, "lights")}
    turn = _tracks(_table(said, "environment"), {"degrees": 1, "axis": 3}, "environment")
    if turn and "degrees" not in turn:
        raise MiNtfError("environment needs degrees")
    return Timeline([Frame(
        number,
        {name: value(number) for name, value in parameters.items()},
        _values(camera, number),
        {name: _values(tracks, number) for name, tracks in lights.items()},
        _values(turn, number),
    ) for number in range(count)], float(fps))


def _table(said: dict, name: str, within: str = "") -> dict:
    found = said.get(name, {})
    if not isinstance(found, dict):
        raise MiNtfError(f"{within}{name} is {shown(found)}, expected a table: [{within}{name}]")
    return found


def _tracks(said: dict, sizes: dict[str, int], name: str) -> dict[str, Track]:
    only(said, tuple(sizes), name)
    return {key: Track(value, sizes[key], f"{name}.{key}") for key, value in said.items()}


def _values(tracks: dict[str, Track], number: int) -> dict[str, Any]:
    """Plain numbers of each track."""
    found = {}
    for key, track in tracks.items():
        value = [float(v) for v in track.at(number)]
        found[key] = value if track.size == 3 else value[0]
    return found


def _parameter(said, name: str):
    """A function of the frame's number to the text of a $name. Texts and whole numbers stay as they are written; keys
    of texts hold until the next."""
    if isinstance(said, bool):
        return lambda _: str(said).lower()
    if isinstance(said, str | int):
        return lambda _: str(said)
    keys = said.get("keys") if isinstance(said, dict) else None
    values = [k[1] for k in keys if isinstance(k, list) and len(k) == 2] if isinstance(keys, list) else []
    step = isinstance(said, dict) and said.get("interpolation", "step") == "step"
    if keys and any(isinstance(v, str | bool) for v in values):
        if not step:
            raise MiNtfError(f'{name}: between texts there is nothing, so interpolation must be "step"')
        order = Track({"keys": [[k[0], i] for i, k in enumerate(keys)], "interpolation": "step"}, 1, name)
        texts = [_parameter(v, name)(0) for v in values]
        return lambda number: texts[int(order.at(number)[0])]
    track = Track(said, 1, name)
    if isinstance(said, dict) and "interpolation" in said and step and all(isinstance(v, int) for v in values):
        return lambda number: str(int(track.at(number)[0]))
    return lambda number: repr(float(track.at(number)[0]))
