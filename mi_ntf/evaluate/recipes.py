"""Recipes that render a scene with other properties of its integrator: XML to paste, and a shell command."""

import functools
import re
import shlex
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import mitsuba as mi

from ..render.scene import changed
from ..render.scene.environment_option import Environment

Value: TypeAlias = bool | int | float | str
Properties: TypeAlias = dict[str, Value]
"""Properties of an integrator by name."""

_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string"}


def integrator_xml(plugin: str, properties: Properties) -> str:
    """Return the element ``<integrator>`` without the properties of ``nrf`` that have their default values."""
    lines = [f'    <{_TAGS[type(value)]} name="{name}" value={quoteattr(_text(value))}/>'
             for name, value in properties.items() if plugin != "nrf" or value != _default(name)]
    return "\n".join([f'<integrator type="{plugin}">', *lines, "</integrator>"]) + "\n"


def render_command(scene: Path, parameters: dict[str, str], properties: Properties, samples: int,
                   environment: Environment | None = None) -> str:
    """Return the shell command that renders a scene whose integrator is ``nrf``.

    Parameters
    ----------
    scene, parameters
        The scene file, and values of its $names.
    properties
        Properties of the integrator. All others must have their defaults, so that no limits apply.
    samples
        Samples a pixel, if the scene takes them from $spp.
    environment
        Changes of the scene's environment.

    Returns
    -------
    str
        The command; "" where the scene's $names cannot set all of the properties.
    """
    element = ElementTree.parse(scene).getroot().find("integrator")
    texts = {} if element is None else {e.get("name", ""): e.get("value", "") for e in element}
    names = {name: text[1:] for name, text in texts.items() if re.fullmatch(r"\$\w+", text)}
    written, _ = _integrator(scene, parameters)
    known = parameters | {names[name]: _text(value) for name, value in properties.items()
                          if name in names and written.get(name, _default(name)) != value}
    for more, count in (({"spp": str(samples)}, samples), ({}, 0)):
        if _sets(scene, known | more, properties, count):
            defined = [word for name, value in (known | more).items() for word in ("-D", f"{name}={value}")]
            changes = environment.words() if environment else []
            return shlex.join(["mi-ntf", "render", *defined, *changes, "-o", "picture.exr", str(scene)])
    return ""


@functools.cache
def _default(name: str) -> Value:
    """Return the default value of a property of ``nrf``."""
    integrator: Any = mi.load_dict({"type": "nrf"})
    value: Value = getattr(integrator.context.settings, name)
    return value


def _text(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:.9g}" if isinstance(value, float) else str(value)


def _integrator(scene: Path, parameters: dict[str, str]) -> tuple[Properties, list[int]]:
    """Return the properties of a scene's integrator, and the samples a pixel of its samplers."""
    nodes = changed.parsed(scene, parameters).nodes
    properties = next(node.props for node in nodes if node.type == mi.ObjectType.Integrator)
    counts = [node.props.get("sample_count", 0) for node in nodes if node.type == mi.ObjectType.Sampler]
    return {name: properties[name] for name in properties.keys()}, counts


def _sets(scene: Path, parameters: dict[str, str], properties: Properties, samples: int) -> bool:
    """Return True if the scene with `parameters` has such an integrator, and `samples` a pixel unless they are 0."""
    try:
        known, counts = _integrator(scene, parameters)
    except RuntimeError:  # the scene lacks a name
        return False
    same = all(known.get(name, _default(name)) == value for name, value in properties.items())
    others = any(value for name, value in known.items() if name not in (*properties, "frames", "timeout"))
    return same and not others and (not samples or counts == [samples])
