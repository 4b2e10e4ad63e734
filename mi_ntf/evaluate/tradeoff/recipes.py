"""How a reader renders one way of a study by hand: XML of the integrator, and a shell command."""

import re
import shlex
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import mitsuba as mi

from ...render.scene import changed
from .subject import PROPERTIES, Subject
from .ways import Way

_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string"}


def xml(way: Way, subject: Subject) -> str:
    """Return the element ``<integrator>`` of `way`. Properties that have the plugin's defaults are left out."""
    default: Any = mi.load_dict({"type": "nrf"})
    lines = [f'    <{_TAGS[type(value)]} name="{name}" value={quoteattr(_text(value))}/>'
             for name, value in way.properties(subject).items()
             if way.plugin != "nrf" or value != getattr(default, name)]
    return "\n".join([f'<integrator type="{way.plugin}">', *lines, "</integrator>"]) + "\n"


def command(way: Way, subject: Subject, samples: int) -> str:
    """Return the shell command that renders `way` with so many samples a pixel, where the scene has a $name for these,
    or "" where the scene's $names cannot say all of the rest."""
    names, own = _names(subject), subject.properties | {"visibility": None}
    wanted = {name: value for name, value in way.properties(subject).items() if value != own[name]}
    if way.plugin != "nrf" or not set(wanted) <= set(names):
        return ""
    parameters = subject.parameters | {names[name]: _text(value) for name, value in wanted.items()}
    if not _says(parameters, way, subject):
        return ""
    more = parameters | {"spp": str(samples)}
    parameters = more if _says(more, way, subject, samples) else parameters
    defined = [word for name, value in parameters.items() for word in ("-D", f"{name}={value}")]
    return shlex.join(["mi-ntf", "render", *defined, "-o", "picture.exr", str(subject.path)])


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:.9g}" if isinstance(value, float) else str(value)


def _names(subject: Subject) -> dict[str, str]:
    """Return the $name of each property of the scene's integrator that is nothing but a $name."""
    found = ElementTree.parse(subject.path).getroot().find("integrator")
    pairs = {} if found is None else {e.get("name", ""): e.get("value", "") for e in found}
    return {name: value[1:] for name, value in pairs.items() if re.fullmatch(r"\$\w+", value)}


def _says(parameters: dict[str, str], way: Way, subject: Subject, samples: int = 0) -> bool:
    """Return True if the scene with `parameters` renders `way`, without limits and files of maps, and with so many
    samples a pixel unless they are 0."""
    try:
        nodes = changed.parsed(subject.path, parameters).nodes
    except RuntimeError:  # a name that the scene does not have
        return False
    integrator = next(node.props for node in nodes if node.type == mi.ObjectType.Integrator)
    known = {name: integrator[name] for name in integrator.keys() if name not in ("frames", "timeout")}
    default = mi.load_dict({"type": "nrf"})
    same = all(known.get(name, getattr(default, name)) == value for name, value in way.properties(subject).items())
    others = any(value for name, value in known.items() if name not in (*PROPERTIES, "visibility"))
    counts = [node.props["sample_count"] for node in nodes if node.type == mi.ObjectType.Sampler]
    return same and not others and (not samples or counts == [samples])
