"""The environment of a scene file, swapped, turned and scaled from the command line: ``--env FILE --env-rotate DEG
--env-scale S``.

It is done between parsing and making the scene, wherever the emitter stands: at the top, in an include, inside of an
``ntf`` emitter.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError

KINDS = ("envmap", "constant", "sunsky", "timed_sunsky")
"""Plugins that are a scene's environment."""
SKIES = ("sunsky", "timed_sunsky")
"""Those whose own up axis is z; the others' is y."""
SKY_TO_MAP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Columns are the axes of a map, y up, in those of a sky, z up."""


@dataclass(frozen=True)
class Environment:
    """What is to become of a scene's environment.

    file    a latitude-longitude image that takes its place and keeps its placement and scale; None: it stays
    rotate  degrees about the world's up axis, counter-clockwise seen from above, on top of the scene's own rotation
    scale   factor of its radiance, on top of the scene's own

    Raises MiNtfError where the file is missing or no image, or a number is none.
    """

    file: Path | None = None
    rotate: float = 0.0
    scale: float = 1.0

    def __post_init__(self):
        if not math.isfinite(self.rotate):
            raise MiNtfError(f"--env-rotate is {self.rotate}, expected a finite number of degrees")
        if not (math.isfinite(self.scale) and self.scale >= 0):
            raise MiNtfError(f"--env-scale is {self.scale}, expected a finite number, 0 or more")
        if self.file is not None:
            if not Path(self.file).is_file():
                raise MiNtfError(f"--env {self.file}: does not exist; give a latitude-longitude image, .exr or .hdr")
            if mi.Bitmap.detect_file_format(mi.FileStream(str(self.file))) == mi.Bitmap.FileFormat.Unknown:
                raise MiNtfError(f"--env {self.file}: no image that Mitsuba reads; give an .exr or .hdr file")

    def __bool__(self) -> bool:
        return self != Environment()


def apply(environment: Environment, state, path: Path) -> None:
    """Change the environment in the parsed scene `state` of the file `path`, before references are resolved.

    A scene without one gets `environment.file` with y up. Raises MiNtfError where there is nothing to turn or scale.
    """
    if not environment:
        return
    nodes = [n for n in state.nodes if n.type == mi.ObjectType.Emitter and n.props.plugin_name() in KINDS]
    if not nodes:
        if environment.file is None:
            raise MiNtfError(f"{path} has no environment to turn or to scale; give one by --env FILE")
        nodes = [_add(state)]
    for node in nodes:
        _change(node, environment)


def turned(to_world: np.ndarray, degrees: float, up: str = "y") -> np.ndarray:
    """(4, 4) `to_world` of an environment, turned by `degrees` about the world's up axis: the coordinate axis that is
    nearest to the environment's own, `up`. Scenes whose z is up turn their maps upright, so it is theirs, too."""
    away = to_world[:3, 1 if up == "y" else 2]
    at = int(np.abs(away).argmax())
    angle = math.radians(degrees) * (1 if away[at] >= 0 else -1)
    first, second = (at + 1) % 3, (at + 2) % 3
    rotation = np.eye(4)
    rotation[[first, second], [first, second]] = math.cos(angle)
    rotation[second, first], rotation[first, second] = math.sin(angle), -math.sin(angle)
    return rotation @ to_world


def _add(state):
    """A new ``envmap`` at the top of the scene, yet without a file."""
    node = mi.parser.SceneNode()
    node.type, node.props = mi.ObjectType.Emitter, mi.Properties("envmap")
    state.nodes.append(node)
    state.root.props["environment_of_the_command_line"] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    return state.nodes[len(state.nodes) - 1]


def _change(node, environment: Environment) -> None:
    kind = node.props.plugin_name()
    up = "z" if kind in SKIES else "y"
    old = _matrix(node.props)
    new = turned(old, environment.rotate, up)
    if environment.file is None and kind == "constant":
        _scale_radiance(node, environment.scale)
        return
    if environment.file is not None:
        _take_file(node, environment.file.resolve())
        new = new @ SKY_TO_MAP if up == "z" else new
        kind = "envmap"
    node.props["to_world"] = mi.ScalarTransform4f(new)
    for name in ("sun_scale", "sky_scale") if kind in SKIES else ("scale",):
        node.props[name] = environment.scale * float(node.props.get(name, 1.0))
    if kind in SKIES and "sun_direction" in node.props:  # in the scene's coordinates
        sun = np.array(node.props["sun_direction"], np.float64)
        node.props["sun_direction"] = ((new @ np.linalg.inv(old))[:3, :3] @ sun).tolist()


def _matrix(props) -> np.ndarray:
    """(4, 4) float64 of its ``to_world``."""
    return np.array(props["to_world"].matrix, np.float64).reshape(4, 4) if "to_world" in props else np.eye(4)


def _take_file(node, file: Path) -> None:
    """Make `node` an ``envmap`` of `file`; of an ``envmap`` all else stays."""
    if node.props.plugin_name() != "envmap":
        props = mi.Properties("envmap")
        props.set_id(node.props.id())
        if "sampling_weight" in node.props:
            props["sampling_weight"] = node.props["sampling_weight"]
        node.props = props
    node.props["filename"] = str(file)


def _scale_radiance(node, scale: float) -> None:
    """Of a ``constant`` emitter, which has no scale of its own."""
    props = node.props
    kind = props.type("radiance").name if "radiance" in props else ""
    found: Any = props["radiance"] if kind else 1.0
    if kind == "Spectrum":
        values = [scale * value for value in found.values]
        props["radiance"] = type(found)(values[0]) if found.is_uniform() else type(found)(found.wavelengths, values)
    elif kind in ("", "Float", "Integer"):
        props["radiance"] = scale * found
    elif kind == "Color":
        props["radiance"] = mi.ScalarColor3d((scale * np.array(found, np.float64)).tolist())
    else:
        raise MiNtfError(f"--env-scale: the radiance of the scene's constant emitter is a nested {kind.lower()}; scale "
                         "it in the XML")
