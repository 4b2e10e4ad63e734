"""Transmittance maps that are made once: kept in memory over frames, on disk over runs.

A map's key is everything that its texels depend on: the field's content, grid and marching step, the lights' places,
resolution, source and number of logistics, and the program text that makes them. Files lie in
``$XDG_CACHE_HOME/mi-ntf/maps`` (default ``~/.cache``); the environment variable ``MI_NTF_MAP_CACHE`` switches: ``on``
(default), ``memory`` (no files), ``off``.
"""

import hashlib
import os
from collections import OrderedDict
from functools import lru_cache
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError

LARGEST_FILE = 256 << 20
FOLDER_LIMIT = 2 << 30
"""Bytes: larger maps are not written; the files used longest ago go when the folder is full."""
MEMORY_LIMIT = 1 << 30

_maps: OrderedDict[str, object] = OrderedDict()


def mode() -> str:
    """``on``, ``memory`` or ``off``."""
    value = os.environ.get("MI_NTF_MAP_CACHE", "on")
    if value not in ("on", "memory", "off"):
        raise MiNtfError(f'environment variable MI_NTF_MAP_CACHE is "{value}", expected on, memory or off')
    return value


def field_hash(path: str) -> str:
    """SHA-256 of a field file's bytes, hexadecimal."""
    stat = Path(path).stat()
    return _field_hash(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=16)
def _field_hash(path: str, _time: int, _size: int) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@lru_cache(maxsize=1)
def _program() -> str:
    """Hash of the modules that texels come from: no map outlives a change of theirs."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted([*(package / "core").rglob("*.py"), *(package / "infer").rglob("*.py")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def key(medium, table, options, width: int) -> str:
    """Name of the map of `table`'s lights; `width`: numbers a texel."""
    grid = medium.field.grid
    facts = (
        _program(), field_hash(medium.path), medium.representation, grid.resolution, options.step,
        options.map_resolution, options.map_source, options.map_components, width, mi.variant(),
    )
    digest = hashlib.sha256(repr(facts).encode())
    for part in (table.where, table.is_point, grid.hull):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def cached(name: str, make, load):
    """The map called `name`: from memory, else ``load(values)`` of the file's numbers, else ``make()``, which is then
    kept.

    A file that cannot be read counts as none, and a folder that cannot be written to is no error: a cache may be lost.
    """
    where = mode()
    if where == "off":
        return make()
    if name in _maps:
        _maps.move_to_end(name)
        return _maps[name]
    file = folder() / f"{name}.npy"
    values = _read(file) if where == "on" else None
    if values is None:
        result = make()
        if where == "on":
            _write(file, result.values)
    else:
        result = load(values)
    _maps[name] = result
    while len(_maps) > 1 and sum(4 * len(m.values) for m in _maps.values()) > MEMORY_LIMIT:
        _maps.popitem(last=False)
    return result


def folder() -> Path:
    """Where the files are."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mi-ntf" / "maps"


def forget() -> None:
    """Drop what is kept in memory."""
    _maps.clear()


def _read(file: Path):
    try:
        values = np.load(file, allow_pickle=False)
        os.utime(file)
        return values
    except (OSError, ValueError, EOFError):
        return None


def _write(file: Path, values) -> None:
    if 4 * len(values) > LARGEST_FILE:
        return
    temporary = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as out:
            np.save(out, np.array(values), allow_pickle=False)
        os.replace(temporary, file)
        _tidy(file.parent)
    except OSError:
        temporary.unlink(missing_ok=True)


def _tidy(where: Path) -> None:
    """Remove the files used longest ago until the folder is within its limit."""
    files = sorted(((f.stat().st_mtime, f.stat().st_size, f) for f in where.glob("*.npy")), reverse=True)
    total = 0
    for _, size, file in files:
        total += size
        if total > FOLDER_LIMIT:
            file.unlink(missing_ok=True)
