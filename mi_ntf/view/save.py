"""XML of a scene that was changed in a view."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from mi_ntf import scene_xml
from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.render.scene.environment_option import KINDS

from .lights import POWER, Light
from .session import Session

CHANGED = ("emitter", "sensor", "integrator")


def beside_scene(session: Session, name: str) -> Path:
    """Return the path of the file `name` beside the scene.

    Raises MiNtfError for any other place and for endings other than .xml: a page may write nowhere else.
    """
    if Path(name).name != name or Path(name).suffix != ".xml":
        raise MiNtfError(f"name is {shown(name)}; scenes are saved beside the opened one: give a name without folders, "
                         "ending in .xml")
    return session.path.with_name(name)


def save(session: Session, out: Path, environment: Path | None = None, camera: bool = False) -> None:
    """Write the scene of `session` as it is now, with the scene's own camera, or with the present one if `camera`.

    Unchanged elements stay as they were written. Includes that hold a light, a sensor or an integrator are inlined,
    comments are lost, and the session's values of $names become their defaults.

    `environment` is a picture file in place of the present one. Raises MiNtfError if `out` is the scene itself, a
    changed light is not an <emitter> of the scene's top level, or a changed environment is a sky.
    """
    if out.resolve() == session.path.resolve():
        raise MiNtfError(f"{out} is the scene that is being viewed; choose another name")
    root = scene_xml.parse(session.path)
    values = {d.get("name", ""): d.get("value", "") for d in root.iter("default")} | session.define
    scene_xml.Includes(session.path.parent, values).inline(
        root, session.path, lambda content: any(content.find(f".//{tag}") is not None for tag in CHANGED))
    scene_xml.move_paths(root, session.path.parent, out.parent, values)
    scene_xml.set_defaults(root, session.define)
    if session.option:
        _write_option(root, session, values)
    for light in session.lights:
        if light.version:
            _write_light(_element(root, session, light, values), light)
    environment = environment or session.environment
    if environment:
        for light in session.lights:
            if light.can_turn:
                place = scene_xml.relative(environment, out.parent)
                _replace(_element(root, session, light, values), ("filename", "bitmap"),
                         ET.Element("string", name="filename", value=place))
    if camera:
        _write_pose(root, session)
    for name in ("visibility", "max_depth"):
        if getattr(session.settings, name) != getattr(session.initial_settings, name):
            _write_setting(root, name, getattr(session.settings, name))
    ET.indent(root, "    ")
    files.make_folder(out.parent)
    files.write(out, ET.tostring(root, encoding="unicode") + "\n")


def _element(root: ET.Element, session: Session, light: Light, values: dict[str, str]) -> ET.Element:
    """Return the XML element of `light`. Mitsuba preserves the order of lights of one kind."""
    elements = [e for e in root.findall("emitter") if scene_xml.substitute(e.get("type", ""), values) == light.kind]
    lights = [other for other in session.lights if other.kind == light.kind]
    if len(elements) != len(lights):
        raise MiNtfError(f"{session.path} has {len(elements)} <emitter> of type {light.kind} at its top level, and the "
                         f"scene {len(lights)}; put them there to save what was changed")
    return elements[lights.index(light)]


def _write_light(element: ET.Element, light: Light) -> None:
    if light.moved and light.kind == "point":
        _replace(element, ("position", "to_world"), _vector("point", "position", light.position))
    elif light.moved:
        _replace(element, ("to_world", "direction"), _matrix(light.placement))
    if light.degrees:
        transform = element.find("transform[@name='to_world']")
        if transform is None:
            transform = ET.SubElement(element, "transform", name="to_world")
        # Mitsuba applies the steps of a transform in their order.
        x, y, z = (repr(float(c)) for c in light.up)
        ET.SubElement(transform, "rotate", x=x, y=y, z=z, angle=repr(light.degrees))
    if light.brightness != 1:
        _write_power(element, light)


def _write_power(element: ET.Element, light: Light) -> None:
    power = light.power
    if power is None:
        return
    name = POWER[light.emitter.class_name()].removesuffix(".value")
    new = (ET.Element("rgb", name=name, value=", ".join(map(_text, power))) if len(power) > 1 else
           ET.Element("float", name=name, value=_text(power[0])))
    _replace(element, (name,), new)


def _write_option(root: ET.Element, session: Session, values: dict[str, str]) -> None:
    """Write the environment as the command line changed it. Its picture is written with that of a view."""
    light = next((light for light in session.lights if light.kind in ("envmap", "constant")), None)
    elements = [e for e in root.findall("emitter") if scene_xml.substitute(e.get("type", ""), values) in KINDS]
    if light is None or len(elements) > 1:
        raise MiNtfError(f"{session.path}: the changes by --env-rotate and --env-scale can be saved for one envmap or "
                         "constant emitter at the scene's top level; write them into the scene by hand")
    element = elements[0] if elements else ET.SubElement(root, "emitter")
    if scene_xml.substitute(element.get("type", ""), values) != light.kind:
        element.set("type", light.kind)
        for child in [c for c in element if c.get("name") != "sampling_weight"]:
            element.remove(child)
    if light.can_turn:
        _replace(element, ("to_world",), _matrix(light.placement))
    _write_power(element, light)


def _write_pose(root: ET.Element, session: Session) -> None:
    """Write origin, target and up of the first sensor. Its field of view stays."""
    sensor = root.find("sensor")
    if sensor is None:
        raise MiNtfError(f"{session.path} has no <sensor> at its top level, so the camera cannot be saved")
    pose, transform = session.pose, ET.Element("transform", name="to_world")
    ET.SubElement(transform, "lookat", {
        name: ", ".join(map(_text, value))
        for name, value in (("origin", pose.origin), ("target", pose.target), ("up", pose.up))})
    _replace(sensor, ("to_world",), transform)


def _write_setting(root: ET.Element, name: str, value: str | int) -> None:
    """Write a property of the integrator, or the default of the $name that it refers to."""
    integrator = root.find("integrator")
    assert integrator is not None  # the scene was rendered by it
    old = next((e for e in integrator if e.get("name") == name), None)
    text = old.get("value", "") if old is not None else ""
    default = next((d for d in root.iter("default") if text == f"${d.get('name')}"), None)
    if default is not None:
        default.set("value", str(value))
    else:
        _replace(integrator, (name,),
                 ET.Element("string" if isinstance(value, str) else "integer", name=name, value=str(value)))


def _replace(parent: ET.Element, names: tuple[str, ...], new: ET.Element) -> None:
    """Replace the children with one of the `names` by `new`."""
    for child in [c for c in parent if c.get("name") in names]:
        parent.remove(child)
    parent.append(new)


def _vector(tag: str, name: str, value: np.ndarray) -> ET.Element:
    x, y, z = map(_text, value)
    return ET.Element(tag, name=name, x=x, y=y, z=z)


def _matrix(value: np.ndarray) -> ET.Element:
    transform = ET.Element("transform", name="to_world")
    ET.SubElement(transform, "matrix", value=" ".join(map(_text, value.ravel())))
    return transform


def _text(value: float) -> str:
    """Format a number with the digits of a float32."""
    return f"{float(value):.9g}"
