"""Camera, lights and environment of a frame, put into its parsed scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import cast

import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from ..render.scene.environment_option import KINDS
from .timeline import Frame, Values

AIMED = ("spot", "projector")


def apply(nodes: Iterable[mi.parser.SceneNode], frame: Frame) -> None:
    """Change the `nodes` of a parsed scene. Raises MiNtfError where the scene lacks what the frame places."""
    nodes = list(nodes)
    emitters = [node.props for node in nodes if node.type == mi.ObjectType.Emitter]
    if frame.camera:
        _place_camera([node.props for node in nodes if node.type == mi.ObjectType.Sensor], frame.camera)
    for name, values in frame.lights.items():
        _place_light(_emitter(emitters, name), name, values)
    if frame.environment:
        _turn_environment([e for e in emitters if e.plugin_name() in KINDS], frame.environment)


def _place_camera(sensors: Sequence[mi.Properties], camera: Values) -> None:
    """Place the first sensor, which is the one that renders."""
    if not sensors:
        raise MiNtfError("the timeline places the camera, but the scene has no sensor; add one to the scene")
    props = sensors[0]
    if "fov" in camera:
        if not 0 < camera["fov"] < 180:
            raise MiNtfError(f"camera.fov is {camera['fov']:g}, expected an angle above 0 and below 180 degrees")
        props["fov"] = camera["fov"]
        if "focal_length" in props:
            del props["focal_length"]
    if "origin" in camera:
        props["to_world"] = _look_at(camera["origin"], camera["target"], camera.get("up", [0.0, 1.0, 0.0]), "camera")


def _emitter(emitters: Sequence[mi.Properties], name: str) -> mi.Properties:
    """Return the emitter with this id, or the only one of this plugin."""
    keys: tuple[Callable[[mi.Properties], str], ...] = (mi.Properties.id, mi.Properties.plugin_name)
    matches: list[mi.Properties] = []
    for key in keys:
        matches = [props for props in emitters if key(props) == name]
        if len(matches) == 1:
            return matches[0]
    known = sorted({props.id() or props.plugin_name() for props in emitters})
    raise MiNtfError(f"lights.{name}: the scene has {len(matches)} emitters of that id or plugin, expected one; it has "
                     f"{', '.join(known) or 'no emitter'}, and an id tells emitters of one plugin apart")


def _place_light(props: mi.Properties, name: str, values: Values) -> None:
    kind = props.plugin_name()
    if kind == "point":
        if "target" in values:
            raise MiNtfError(f"lights.{name}: a point light shines everywhere and has no target; remove it")
        if "to_world" in props:
            del props["to_world"]
        props["position"] = values["position"]
    elif kind == "directional" and set(values) == {"position", "target"}:
        if "to_world" in props:
            del props["to_world"]
        props["direction"] = (np.array(values["target"]) - values["position"]).tolist()
    elif kind in AIMED:
        before = _to_world(props)
        position = np.array(before.translation()).ravel()
        origin = values.get("position", position.tolist())
        if "target" in values:
            way = np.subtract(values["target"], origin)
            is_along_y = abs(way[1]) >= 0.999 * np.linalg.norm(way)
            up = [0.0, 0.0, 1.0] if is_along_y else [0.0, 1.0, 0.0]
            props["to_world"] = _look_at(origin, values["target"], up, f"lights.{name}")
        else:
            props["to_world"] = mi.ScalarTransform4f().translate((np.array(origin) - position).tolist()) @ before
    else:
        raise MiNtfError(f"lights.{name} is a {kind} emitter, but a timeline moves point, spot and projector lights by "
                         "position, and directional ones by position and target; give the scene a $name for its place")


def _turn_environment(emitters: Sequence[mi.Properties], values: Values) -> None:
    if len(emitters) != 1:
        raise MiNtfError(f"the timeline turns the environment, but the scene has {len(emitters)} of them; expected one "
                         f"emitter among {', '.join(KINDS)}")
    axis = values.get("axis", [0.0, 1.0, 0.0])
    if not np.linalg.norm(axis) > 0:
        raise MiNtfError(f"environment.axis is {axis}, expected a vector other than 0")
    props = emitters[0]
    if props.plugin_name() != "constant":
        turn = mi.ScalarTransform4f().rotate(axis, values["degrees"])
        props["to_world"] = turn @ _to_world(props)
        if "sun_direction" in props:  # in the scene's coordinates
            props["sun_direction"] = np.array(turn @ mi.ScalarVector3f(props["sun_direction"])).tolist()


def _to_world(props: mi.Properties) -> mi.ScalarTransform4f:
    return cast("mi.ScalarTransform4f", props.get("to_world", mi.ScalarTransform4f()))


def _look_at(origin: list[float], target: list[float], up: list[float], name: str) -> mi.ScalarTransform4f:
    way = np.subtract(target, origin)
    if not np.linalg.norm(np.cross(way, up)) > 1e-9 * np.linalg.norm(way) * np.linalg.norm(up):
        raise MiNtfError(f"{name}: from origin {origin} to target {target} with up {up} there is no upright view; "
                         "origin and target must differ, and up must point another way")
    return cast("mi.ScalarTransform4f", mi.ScalarTransform4f().look_at(origin, target, up))
