"""Scene files: what `mi.load_file` makes of them, with another environment where wanted, and which files they read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import mitsuba as mi

from ...core.errors import MiNtfError
from . import changed, environment_option
from .environment_option import Environment

FILES = ("filename", "map_file")
"""Properties of plugins that name a file."""


def load(path: Path, parameters: dict[str, str], environment: Environment | None = None,
         seen: Callable[[Path], None] | None = None) -> Any:
    """The scene of the XML file `path` in the current variant, `parameters` for its $names.

    `environment` is laid over the scene's own (:class:`Environment`). `seen` is called with each file that the scene
    reads as soon as it is known, in most cases before it is read: the XML file, its includes, fields, images, meshes.

    Raises MiNtfError where the file is missing or the environment does not fit, and RuntimeError as Mitsuba does.
    """
    path = Path(path)
    seen = seen or (lambda _: None)
    seen(path.resolve())
    if not path.is_file():
        raise MiNtfError(f"scene {path} does not exist")
    with changed.beside(path):
        state = changed.parsed(path, parameters)
        for name in state.files:
            seen(Path(str(name)).resolve())
        environment_option.apply(environment or Environment(), state, path)
        for file in _named(state):
            seen(file)
        return changed.instantiated(path, state)


def render_to_film(scene: Any, sensor: Any) -> None:
    """Render `scene` with its integrator; the film of `sensor` holds the picture.

    Mitsuba's integrators that are written in Python (``prb`` and others) refuse not to develop, although the film has
    all samples by then.
    """
    integrator = scene.integrator()
    integrator.render(scene, sensor, develop=type(integrator).__module__.startswith("mitsuba.python."))


def _named(state) -> set[Path]:
    """Files that the plugins of a parsed scene read."""
    found, resolver = set(), cast(Any, mi).file_resolver()
    for node in state.nodes:
        for name in FILES:
            if name in node.props and node.props.type(name).name == "String":
                found.add(Path(str(resolver.resolve(node.props[name]))).resolve())
    return found
