"""Scenes that differ from their XML file: parsed, changed, then instantiated."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import mitsuba as mi

from ...core.errors import MiNtfError
from .. import log

Node: TypeAlias = "mi.parser.SceneNode"
ParsedScene: TypeAlias = "mi.parser.ParserState"


def shrink_film(props: mi.Properties, shrink: int) -> None:
    """Divide the sides of a film and of its crop by `shrink`, and make it RGBA; `props`: the film's properties."""
    for name, default in (("width", 768), ("height", 576)):
        props[name] = max(1, int(str(props.get(name, default))) // shrink)
    for name in ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"):
        if name in props:
            props[name] = int(str(props[name])) // shrink
    props["pixel_format"] = "rgba"


def parsed(path: Path, parameters: dict[str, str], strict: bool = True) -> ParsedScene:
    """Return the parsed XML file, with `parameters` for its $names."""
    with beside(path):
        return mi.parser.parse_file(_config(strict), str(path), **parameters)


def content_of_files(state: ParsedScene) -> bytes:
    """Return a hash of the content of all files that a parsed scene names; call it within :func:`beside`."""
    digest = hashlib.sha256()
    for node in state.nodes:
        for name in node.props:
            if "file" in name and node.props.type(name) == mi.Properties.Type.String:
                digest.update(_content(Path(log.resolve(node.props[name]))))
    return digest.digest()


def _content(path: Path) -> bytes:
    """Return a hash of a file's content, empty where it is missing: the plugin that needs it raises the error."""
    if not path.is_file():
        return b""
    stat = path.stat()
    return _hashed(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=256)
def _hashed(path: Path, _time: int, _size: int) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


def instantiated(path: Path, state: ParsedScene, strict: bool = True) -> mi.Scene:
    """Return the scene of a state :func:`parsed` from `path`, with all changes made since."""
    with beside(path):
        mi.parser.transform_all(_config(strict), state)
        objects = mi.parser.instantiate(_config(strict), state)
    scene = objects[0] if isinstance(objects, list) else objects
    if not isinstance(scene, mi.Scene):
        raise MiNtfError(f"{path}: the root element must be a <scene>")
    return scene


@contextmanager
def beside(path: Path) -> Iterator[None]:
    """Within the block, search files beside `path` first, as Mitsuba does when it loads a file by itself."""
    before = mi.file_resolver()  # type: ignore[operator]  # Mitsuba's stubs leave both out
    within = mi.FileResolver(before)
    within.prepend(str(Path(path).parent))
    mi.set_file_resolver(within)  # type: ignore[operator]
    try:
        yield
    finally:
        mi.set_file_resolver(before)  # type: ignore[operator]


def _config(strict: bool) -> mi.parser.ParserConfig:
    config = mi.parser.ParserConfig(str(mi.variant()))
    if not strict:
        config.unused_parameters = mi.LogLevel.Debug
    return config
