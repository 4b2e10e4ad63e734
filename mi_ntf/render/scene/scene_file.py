"""Scene files: loading them with another environment, and the files that they read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi

from ...core.errors import MiNtfError
from .. import log
from . import changed, environment_option
from .environment_option import Environment

FILES = ("filename", "map_file")
"""Properties of plugins that name a file."""


def load(path: Path, parameters: dict[str, str], environment: Environment | None = None,
         on_file: Callable[[Path], None] | None = None, change: Callable[[changed.Node], None] | None = None,
         strict: bool = True) -> mi.Scene:
    """Return the scene of an XML file in the current variant.

    Parameters
    ----------
    path
        The XML file.
    parameters
        Values of its $names.
    environment
        Changes of the scene's environment.
    on_file
        Function called with each file that the scene reads, in most cases before it is read: the XML file, its
        includes, fields, images, meshes.
    change
        Function called with each node of the parsed scene, which has a ``type`` and ``props``.
    strict
        Values for $names that the file does not contain are an error.

    Raises
    ------
    MiNtfError
        If the file is missing or the environment does not fit.
    RuntimeError
        If Mitsuba cannot load the scene.
    """
    path, on_file = Path(path), on_file or (lambda _: None)
    on_file(path.resolve())
    if not path.is_file():
        raise MiNtfError(f"scene {path} does not exist")
    with changed.beside(path):
        state = changed.parsed(path, parameters, strict)
        for name in state.files:
            on_file(Path(str(name)).resolve())
        environment_option.apply(environment or Environment(), state, path)
        for file in _named(state):
            on_file(file)
        if change:
            for node in state.nodes:
                change(node)
        return changed.instantiated(path, state, strict)


def render_to_film(scene: mi.Scene, sensor: mi.Sensor) -> None:
    """Render `scene` with its integrator into the film of `sensor`.

    Mitsuba's integrators that are written in Python, such as ``prb``, only render if they may develop the film, too.
    """
    integrator = scene.integrator()
    integrator.render(scene, sensor, develop=type(integrator).__module__.startswith("mitsuba.python."))


def _named(state: changed.ParsedScene) -> set[Path]:
    """Return the files that the plugins of a parsed scene name."""
    return {Path(log.resolve(node.props[name])).resolve() for node in state.nodes for name in FILES
            if name in node.props and node.props.type(name).name == "String"}
