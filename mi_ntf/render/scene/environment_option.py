"""Changes of a scene's environment from the command line: ``--env FILE --env-rotate DEG --env-scale S``.

They are made between parsing and instantiation, so that they reach an emitter at the top of the scene, in an include or
inside an ``ntf`` emitter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ...core import rotation
from ...core.errors import MiNtfError
from ...infer.types import Array
from .changed import Node, ParsedScene

KINDS = ("envmap", "constant", "sunsky", "timed_sunsky")
"""Plugins of environment emitters."""
SKIES = ("sunsky", "timed_sunsky")
"""Plugins whose up axis is z; that of the others is y."""
SKY_TO_MAP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Rotation from an environment map, whose up axis is y, to a sky, whose up axis is z."""


@dataclass(frozen=True)
class Environment:
    """Changes of a scene's environment.

    file    latitude-longitude image that replaces the environment, with the same placement and scale; None: no change
    rotate  degrees about the world's up axis, counter-clockwise seen from above, added to the scene's own rotation
    scale   factor by which the scene's own radiance is multiplied

    Raises MiNtfError if the file is missing or no image, or if a number is not finite.
    """

    file: Path | None = None
    rotate: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
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

    def words(self) -> list[str]:
        """Return the options of the command line that stand for these changes."""
        changes = {"--env": (self.file, None), "--env-rotate": (self.rotate, 0), "--env-scale": (self.scale, 1)}
        return [f"{name}={value}" for name, (value, default) in changes.items() if value != default]


def apply(environment: Environment, state: ParsedScene, path: Path) -> None:
    """Change the environment in the parsed scene `state` of the file `path`, before references are resolved.

    A scene without an environment gets `environment.file` with y up. Raises MiNtfError if there is no environment to
    rotate or scale.
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
    """Return the (4, 4) `to_world` of an environment, rotated by `degrees` about the world's up axis.

    `up`: the environment's own up axis, ``y`` or ``z``. The world's up axis is the coordinate axis nearest to it, since
    scenes with z up turn their maps upright.
    """
    direction = to_world[:3, 1 if up == "y" else 2]
    axis = int(np.abs(direction).argmax())
    result: np.ndarray = to_world.copy()
    result[:3] = rotation.about(np.eye(3)[axis], degrees if direction[axis] >= 0 else -degrees) @ to_world[:3]
    return result


def _add(state: ParsedScene) -> Node:
    """Add an ``envmap`` without a file at the top of the scene, and return it."""
    node = mi.parser.SceneNode()
    node.type, node.props = mi.ObjectType.Emitter, mi.Properties("envmap")
    state.nodes.append(node)
    state.root.props["environment_of_the_command_line"] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    return state.nodes[len(state.nodes) - 1]


def _change(node: Node, environment: Environment) -> None:
    kind = node.props.plugin_name()
    up = "z" if kind in SKIES else "y"
    old = _matrix(node.props)
    new = turned(old, environment.rotate, up)
    if environment.file is None and kind == "constant":
        _scale_radiance(node, environment.scale)
        return
    if environment.file is not None:
        _replace(node, environment.file.resolve())
        new = new @ SKY_TO_MAP if up == "z" else new
        kind = "envmap"
    node.props["to_world"] = mi.ScalarTransform4f(new)
    for name in ("sun_scale", "sky_scale") if kind in SKIES else ("scale",):
        node.props[name] = environment.scale * float(node.props.get(name, 1.0))
    if kind in SKIES and "sun_direction" in node.props:  # in the scene's coordinates
        sun = np.array(node.props["sun_direction"], np.float64)
        node.props["sun_direction"] = ((new @ np.linalg.inv(old))[:3, :3] @ sun).tolist()


def _matrix(props: mi.Properties) -> np.ndarray:
    """Return the ``to_world`` of an emitter as (4, 4) float64."""
    transform: Array = props["to_world"] if "to_world" in props else mi.ScalarTransform4f()
    return np.array(transform.matrix, np.float64).reshape(4, 4)


def _replace(node: Node, file: Path) -> None:
    """Make `node` an ``envmap`` of `file`; an ``envmap`` keeps its other properties."""
    if node.props.plugin_name() != "envmap":
        props = mi.Properties("envmap")
        props.set_id(node.props.id())
        if "sampling_weight" in node.props:
            props["sampling_weight"] = node.props["sampling_weight"]
        node.props = props
    node.props["filename"] = str(file)


def _scale_radiance(node: Node, scale: float) -> None:
    """Scale the radiance of a ``constant`` emitter, which has no property `scale`."""
    props = node.props
    kind = props.type("radiance").name if "radiance" in props else ""
    radiance: Array = props["radiance"] if kind else 1.0
    if kind == "Spectrum":
        values = [scale * value for value in radiance.values]
        spectrum = type(radiance)
        props["radiance"] = (spectrum(values[0]) if radiance.is_uniform()
                             else spectrum(radiance.wavelengths, values))
    elif kind in ("", "Float", "Integer"):
        props["radiance"] = scale * radiance
    elif kind == "Color":
        props["radiance"] = mi.ScalarColor3d((scale * np.array(radiance, np.float64)).tolist())
    else:
        raise MiNtfError(f"--env-scale: the radiance of the scene's constant emitter is a nested {kind.lower()}; scale "
                         "it in the XML")
