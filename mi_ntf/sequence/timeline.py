"""Timelines: TOML files that say what changes from frame to frame.

    frames = 120                     # how many; numbers count from 0
    fps = 24                         # of the film (default: 24)

    [parameters]                     # $names of the scene, as -D gives them
    visibility = "transmittance_map"
    power = { keys = [[0, 1.0], [60, 3.0], [119, 1.0]], interpolation = "smooth" }

    [camera]                         # the sensor: `origin` with `target`, `up`, `fov`
    origin = { keys = [[0, [-1, 1.4, 3.7]], [60, [0, 2, 3.5]], [119, [1, 1.4, 3.7]]] }
    target = [0.1, 0.8, 0]

    [lights.point]                   # an emitter by its id, or by its plugin where only one has it
    position = { start = [2, 3, 3], centre = [0, 0, 0], axis = [0, 1, 0], degrees = { keys = [[0, 0], [120, 360]] } }

    [environment]
    degrees = { keys = [[0, 0], [120, 360]], interpolation = "linear" }
    axis = [0, 1, 0]

Interpolations: :mod:`mi_ntf.sequence.curves`. Lengths are scene lengths, angles degrees.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from ..core.errors import MiNtfError, shown
from .curves import Circle, Keys, check_names, is_number, track

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_FRAMES = 10**7
CAMERA = {"origin": 3, "target": 3, "up": 3, "fov": 1}
"""Values of the camera, and the number of components of each."""
LIGHT = {"position": 3, "target": 3}
ENVIRONMENT = {"degrees": 1, "axis": 3}
Values: TypeAlias = dict[str, Any]
"""Values of one frame by name: floats, or lists of three."""


@dataclass(frozen=True)
class Frame:
    """Values that frame `number` puts into the scene."""

    number: int
    parameters: dict[str, str] = field(default_factory=dict)  # of $names, as text
    camera: Values = field(default_factory=dict)
    lights: dict[str, Values] = field(default_factory=dict)  # by the light's name
    environment: Values = field(default_factory=dict)

    def values(self) -> Values:
        """Return the non-empty values, without the number, as plain data."""
        return {key: value for key, value in asdict(self).items() if value and key != "number"}


@dataclass(frozen=True)
class Timeline:
    """Frames in order, and the number of frames per second of their film."""

    frames: list[Frame]
    fps: float = 24.0


def read(path: str | Path, fixed: dict[str, str] | None = None) -> Timeline:
    """Return the timeline of the TOML file `path`.

    `fixed` has values of $names, which override those of the file. Raises MiNtfError that names the wrong entry.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise MiNtfError(f"timeline {path} cannot be read ({error.strerror}); give a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise MiNtfError(f"timeline {path} is no TOML file: {error}") from None
    try:
        return parse(tables, fixed or {})
    except MiNtfError as error:
        raise MiNtfError(f"timeline {path}: {error}") from None


def parse(tables: Mapping[str, object], fixed: dict[str, str]) -> Timeline:
    """Return the timeline of the parsed TOML `tables`, see :func:`read`."""
    check_names(tables, ("frames", "fps", "parameters", "camera", "lights", "environment"), "top level")
    count, fps = tables.get("frames"), tables.get("fps", 24)
    if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MAX_FRAMES:
        raise MiNtfError(f"frames is {shown(count)}, expected a whole number from 1 to {MAX_FRAMES}")
    if not is_number(fps) or not 0 < fps <= 1000:
        raise MiNtfError(f"fps is {shown(fps)}, expected a number above 0, at most 1000")
    parameters = {name: _parameter(value, f"parameters.{name}") for name, value in _table(tables, "parameters").items()}
    camera = _tracks(_table(tables, "camera"), CAMERA, "camera")
    if ("origin" in camera) != ("target" in camera) or ("up" in camera and "origin" not in camera):
        raise MiNtfError("camera needs both origin and target, or neither of them and no up")
    lights = {name: _tracks(_table(_table(tables, "lights"), name, "lights."), LIGHT, f"lights.{name}")
              for name in _table(tables, "lights")}
    environment = _tracks(_table(tables, "environment"), ENVIRONMENT, "environment")
    if environment and "degrees" not in environment:
        raise MiNtfError("environment needs degrees")
    return Timeline([Frame(
        number,
        {name: text(number) for name, text in parameters.items()} | fixed,
        _values(camera, number),
        {name: _values(tracks, number) for name, tracks in lights.items()},
        _values(environment, number),
    ) for number in range(count)], float(fps))


def _table(tables: Mapping[str, object], name: str, parent: str = "") -> dict[str, object]:
    table = tables.get(name, {})
    if not isinstance(table, dict):
        raise MiNtfError(f"{parent}{name} is {shown(table)}, expected a table: [{parent}{name}]")
    return table


def _tracks(table: Mapping[str, object], sizes: dict[str, int], name: str) -> dict[str, Keys | Circle]:
    check_names(table, tuple(sizes), name)
    return {key: track(value, sizes[key], f"{name}.{key}") for key, value in table.items()}


def _values(tracks: Mapping[str, Keys | Circle], number: int) -> Values:
    """Return the value of each track in frame `number` as plain numbers."""
    values = {key: [float(v) for v in curve.at(number)] for key, curve in tracks.items()}
    return {key: value if len(value) == 3 else value[0] for key, value in values.items()}


def _parameter(value: object, name: str) -> Callable[[int], str]:
    """Return a function of the frame's number that gives the text of a $name.

    Texts and whole numbers stay as they are written. A key of a text holds until the next.
    """
    if isinstance(value, bool):
        return lambda _: str(value).lower()
    if isinstance(value, str | int):
        return lambda _: str(value)
    keys = value.get("keys") if isinstance(value, dict) else None
    key_values = [k[1] for k in keys if isinstance(k, list) and len(k) == 2] if isinstance(keys, list) else []
    is_step = isinstance(value, dict) and value.get("interpolation", "step") == "step"
    if isinstance(keys, list) and len(key_values) == len(keys) and any(isinstance(v, str | bool) for v in key_values):
        if not is_step:
            raise MiNtfError(f'{name}: texts cannot be interpolated, so interpolation must be "step"')
        positions = track({"keys": [[k[0], i] for i, k in enumerate(keys)], "interpolation": "step"}, 1, name)
        texts = [_parameter(v, name)(0) for v in key_values]
        return lambda number: texts[int(positions.at(number)[0])]
    curve = track(value, 1, name)
    if isinstance(value, dict) and "interpolation" in value and is_step and all(isinstance(v, int) for v in key_values):
        return lambda number: str(int(curve.at(number)[0]))
    return lambda number: repr(float(curve.at(number)[0]))
