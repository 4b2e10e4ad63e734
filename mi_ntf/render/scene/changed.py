"""Scenes that differ from their XML file: parsed, changed, then instantiated."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

from ...core.errors import MiNtfError


def load(path: Path, parameters: dict[str, str], change: Callable[[Any], None], strict: bool = True):
    """The scene of an XML file after `change` has seen every node of it, each with a ``type`` and ``props``. `strict`:
    values for names that the file lacks are an error."""
    with beside(path):
        state = parsed(path, parameters, strict)
        for node in state.nodes:
            change(node)
        return instantiated(path, state, strict)


def shrink_film(props, shrink: int) -> None:
    """Make a film RGBA, with one pixel for `shrink` along each side of it and of its crop; `props`: its properties."""
    for name, default in (("width", 768), ("height", 576)):
        props[name] = max(1, int(props.get(name, default)) // shrink)
    for name in ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"):
        if name in props:
            props[name] = int(props[name]) // shrink
    props["pixel_format"] = "rgba"


def parsed(path: Path, parameters: dict[str, str], strict: bool = True):
    """Return the parsed XML file, `parameters` for its $names: ``nodes``, each with a ``type`` and ``props``."""
    with beside(path):
        return mi.parser.parse_file(_config(strict), str(path), **parameters)


def instantiated(path: Path, state, strict: bool = True):
    """The scene of what was :func:`parsed` from `path`, with all changes since."""
    with beside(path):
        mi.parser.transform_all(_config(strict), state)
        found = mi.parser.instantiate(_config(strict), state)
    scene = found[0] if isinstance(found, list) else found
    if not isinstance(scene, mi.Scene):
        raise MiNtfError(f"{path}: the root element must be a <scene>")
    return scene


@contextmanager
def beside(path: Path) -> Iterator[None]:
    """Within, files are looked for beside `path` first, as where Mitsuba loads a file by itself."""
    before = mi.file_resolver()  # type: ignore[operator]  # an object in the stub
    within = mi.FileResolver(before)
    within.prepend(str(Path(path).parent))
    put: Any = mi.set_file_resolver
    put(within)
    try:
        yield
    finally:
        put(before)


def _config(strict: bool):
    config = mi.parser.ParserConfig(str(mi.variant()))
    if not strict:
        config.unused_parameters = mi.LogLevel.Debug
    return config
