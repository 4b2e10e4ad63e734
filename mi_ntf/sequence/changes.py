"""A frame's camera, lights and environment, put into what was parsed of its scene."""

import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from .timeline import Frame

ENVIRONMENTS = ("envmap", "constant", "sunsky")
AIMED = ("spot", "projector")


def apply(nodes, frame: Frame) -> None:
    """Change `nodes`, those of :func:`mi_ntf.render.scene.changed.parsed`. Raises MiNtfError where the scene lacks what
    the frame places."""
    emitters = [n.props for n in nodes if n.type == mi.ObjectType.Emitter]
    if frame.camera:
        _camera([n.props for n in nodes if n.type == mi.ObjectType.Sensor], frame.camera)
    for name, place in frame.lights.items():
        _light(_named(emitters, name), name, place)
    if frame.environment:
        _environment([e for e in emitters if e.plugin_name() in ENVIRONMENTS], frame.environment)


def _camera(sensors: list, camera: dict) -> None:
    """The first sensor, which is the one that renders."""
    if not sensors:
        raise MiNtfError("the timeline places the camera, but the scene has no sensor; add one to the scene")
    props = sensors[0]
    if "fov" in camera:
        if not 0 < camera["fov"] < 180:
            raise MiNtfError(f"camera.fov is {camera['fov']:g}, expected an angle above 0 and below 180 degrees")
        props["fov"] = camera["fov"]
    if "origin" in camera:
        props["to_world"] = _look_at(camera["origin"], camera["target"], camera.get("up", [0.0, 1.0, 0.0]), "camera")


def _named(emitters: list, name: str):
    """The emitter of this id, or the only one of this plugin."""
    for key in (lambda props: props.id(), lambda props: props.plugin_name()):
        found = [props for props in emitters if key(props) == name]
        if len(found) == 1:
            return found[0]
    known = sorted({props.id() or props.plugin_name() for props in emitters})
    raise MiNtfError(f"lights.{name}: the scene has {len(found)} emitters of that id or plugin, expected one; it has "
                     f"{', '.join(known) or 'no emitter'}, and an id tells alike ones apart")


def _light(props, name: str, place: dict) -> None:
    kind = props.plugin_name()
    if kind == "point":
        if "target" in place:
            raise MiNtfError(f"lights.{name}: a point light shines everywhere and has no target; remove it")
        if "to_world" in props:
            del props["to_world"]
        props["position"] = place["position"]
    elif kind == "directional" and set(place) == {"position", "target"}:
        if "to_world" in props:
            del props["to_world"]
        props["direction"] = (np.array(place["target"]) - place["position"]).tolist()
    elif kind in AIMED:
        before = props.get("to_world", mi.ScalarTransform4f())
        origin = place.get("position", np.array(before.translation()).ravel().tolist())
        if "target" in place:
            up = [0.0, 1.0, 0.0] if _across(origin, place["target"]) else [0.0, 0.0, 1.0]
            props["to_world"] = _look_at(origin, place["target"], up, f"lights.{name}")
        else:
            step = np.array(origin) - np.array(before.translation()).ravel()
            props["to_world"] = mi.ScalarTransform4f().translate(step.tolist()) @ before
    else:
        raise MiNtfError(f"lights.{name} is a {kind} emitter, but a timeline moves point, spot and projector lights by "
                         "position, and directional ones by position and target; give the scene a $name for its place")


def _environment(emitters: list, turn: dict) -> None:
    if len(emitters) != 1:
        raise MiNtfError(f"the timeline turns the environment, but the scene has {len(emitters)} of them; expected one "
                         f"emitter among {', '.join(ENVIRONMENTS)}")
    axis = turn.get("axis", [0.0, 1.0, 0.0])
    if not np.linalg.norm(axis) > 0:
        raise MiNtfError(f"environment.axis is {axis}, expected a vector other than 0")
    (props,) = emitters
    if props.plugin_name() != "constant":  # alike on all sides
        before = props.get("to_world", mi.ScalarTransform4f())
        props["to_world"] = mi.ScalarTransform4f().rotate(axis, turn["degrees"]) @ before


def _look_at(origin: list, target: list, up: list, name: str):
    way = np.subtract(target, origin)
    if not np.linalg.norm(np.cross(way, up)) > 1e-9 * np.linalg.norm(way) * np.linalg.norm(up):
        raise MiNtfError(f"{name}: from origin {origin} to target {target} with up {up} there is no upright view; "
                         "origin and target must differ, and up must point another way")
    return mi.ScalarTransform4f().look_at(origin, target, up)


def _across(origin, target) -> bool:
    """Whether the way is clearly not along y."""
    way = np.subtract(target, origin)
    return bool(abs(way[1]) < 0.999 * np.linalg.norm(way))
