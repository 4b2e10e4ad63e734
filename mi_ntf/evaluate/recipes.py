"""Recipes that render a scene with other properties of its integrator: XML to paste, and a shell command."""

import re
import shlex
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import mitsuba as mi

from ..render.scene import changed

_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string"}


def integrator_xml(plugin: str, properties: dict[str, Any]) -> str:
    """Return the element ``<integrator>``. Properties of ``nrf`` that have their default values are left out."""
    default = mi.load_dict({"type": plugin})
    lines = [f'    <{_TAGS[type(value)]} name="{name}" value={quoteattr(_text(value))}/>'
             for name, value in properties.items() if plugin != "nrf" or value != getattr(default, name)]
    return "\n".join([f'<integrator type="{plugin}">', *lines, "</integrator>"]) + "\n"


def render_command(scene: Path, parameters: dict[str, str], properties: dict[str, Any], samples: int) -> str:
    """Return the shell command that renders a scene whose integrator is ``nrf``.

    Parameters
    ----------
    scene, parameters
        The scene file, and values of its $names.
    properties
        Properties that the integrator is to have; others are to have their defaults, so that no limits hold.
    samples
        Samples a pixel, where the scene has the name $spp for them.

    Returns
    -------
    str
        "" where the scene's $names cannot say all of the properties.
    """
    element = ElementTree.parse(scene).getroot().find("integrator")
    texts = {} if element is None else {e.get("name", ""): e.get("value", "") for e in element}
    names = {name: text[1:] for name, text in texts.items() if re.fullmatch(r"\$\w+", text)}
    written, default = _integrator(scene, parameters)[0], mi.load_dict({"type": "nrf"})
    known = parameters | {names[name]: _text(value) for name, value in properties.items()
                          if name in names and written.get(name, getattr(default, name)) != value}
    for more, count in (({"spp": str(samples)}, samples), ({}, 0)):
        if _says(scene, known | more, properties, count):
            defined = [word for name, value in (known | more).items() for word in ("-D", f"{name}={value}")]
            return shlex.join(["mi-ntf", "render", *defined, "-o", "picture.exr", str(scene)])
    return ""


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:.9g}" if isinstance(value, float) else str(value)


def _integrator(scene: Path, parameters: dict[str, str]) -> tuple[dict[str, Any], list[int]]:
    """Return the properties of a scene's integrator, and its samplers' samples a pixel."""
    nodes = changed.parsed(scene, parameters).nodes
    properties = next(node.props for node in nodes if node.type == mi.ObjectType.Integrator)
    counts = [node.props.get("sample_count", 0) for node in nodes if node.type == mi.ObjectType.Sampler]
    return {name: properties[name] for name in properties.keys()}, counts


def _says(scene: Path, parameters: dict[str, str], properties: dict[str, Any], samples: int) -> bool:
    """Return True if the scene with `parameters` has an integrator of these properties, and so many samples a pixel
    unless they are 0."""
    try:
        known, counts = _integrator(scene, parameters)
    except RuntimeError:  # a name that the scene does not have
        return False
    default = mi.load_dict({"type": "nrf"})
    same = all(known.get(name, getattr(default, name)) == value for name, value in properties.items())
    others = any(value for name, value in known.items() if name not in (*properties, "frames", "timeout"))
    return same and not others and (not samples or counts == [samples])
