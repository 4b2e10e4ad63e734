"""Transmittance maps that are made once: kept in memory over frames, on disk over runs.

A map's key is everything that its texels depend on: the field's content, grid and marching step, the lights' places,
resolution, source and number of logistics, the program text that makes them and the libraries that run it. Files lie
in ``maps`` of the user's cache (:mod:`mi_ntf.render.user_cache`), each under a hash of its content: one that is not
what was written counts as none. The environment variable ``MI_NTF_MAP_CACHE`` switches: ``on`` (default), ``memory``
(no files), ``off``.
"""

import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from .. import user_cache

LARGEST_FILE = 256 << 20
FOLDER_LIMIT = 2 << 30
"""Bytes: larger maps are not written; the files used longest ago go when the folder is full."""
SEAL = hashlib.sha256().digest_size
"""Bytes at the start of a file that depend on all others and on its name; numbers follow."""

FULL = np.dtype("<f4")

# Guards `_maps`, `_lights` and `_used`. It is not held while a map is made, since a thread that waits for the map's
# kernels may execute a task that makes another map.
_lock = threading.Lock()
_maps: OrderedDict[str, Any] = OrderedDict()
_lights: dict[str, list] = {}
"""Of those that say it, what each of their lights is called (:func:`lights`)."""
_written = True
_used: set[str] = set()
"""Names of maps in memory that were asked for since :func:`keep_used` was called last."""


def mode() -> str:
    """``on``, ``memory`` or ``off``."""
    value = os.environ.get("MI_NTF_MAP_CACHE", "on")
    if value not in ("on", "memory", "off"):
        raise MiNtfError(f'environment variable MI_NTF_MAP_CACHE is "{value}", expected on, memory or off')
    return value


@lru_cache(maxsize=1)
def _program() -> str:
    """Hash of the modules that texels come from: no map outlives a change of theirs."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted([*(package / "core").rglob("*.py"), *(package / "infer").rglob("*.py")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _libraries() -> tuple:
    """Versions of what runs the program in the current variant."""
    compiler = dr.detail.cuda_version if str(mi.variant()).startswith("cuda") else dr.detail.llvm_version
    versions = mi.__version__, dr.__version__, np.__version__  # type: ignore[attr-defined]  # not in the stubs
    return *versions, compiler()


def key(medium, table, options, width: int, step: float) -> str:
    """Name of the map of `table`'s lights; `width`: numbers a texel; `step`: of the march that makes it, field
    units."""
    grid = medium.field.grid
    digest = hashlib.sha256(repr(_facts(medium, options, width, step)).encode())
    for part in (table.where, table.is_point, grid.hull):
        digest.update(np.ascontiguousarray(part).data)
    return digest.hexdigest()


def _facts(medium, options, width: int, step: float) -> tuple:
    """Return the inputs of the texels besides the lights and the hull, which is the field's."""
    return (
        _program(), _libraries(), medium.field.digest, medium.representation, medium.field.grid.resolution,
        options.step, step, options.map_resolution, options.map_source, options.map_components, width, mi.variant(),
    )


def lights(medium, table, options, width: int, step: float) -> list:
    """A name for the map of each light of `table` by itself."""
    facts = _facts(medium, options, width, step)
    rows = zip(table.where, table.is_point, strict=True)
    return [(facts, where.tobytes(), bool(is_point)) for where, is_point in rows]


def cached(name: str, make, count: int, limit: float, each: list | None = None, some=None, kind: type = np.float32):
    """The map called `name`, of `count` numbers of NumPy's `kind`: from memory, else ``make(values)`` of those in its
    file, else ``make()``, which is then kept on disk.

    `limit`: bytes that maps in memory may take, this one and its making included; a map that takes more is not kept
    there. `each`: :func:`lights`, where a map in memory may hold some of them already; ``some(rows)`` then makes the
    map of the others.
    """
    where, dtype = mode(), np.dtype(kind).newbyteorder("<")
    size = dtype.itemsize * count
    if where == "off":
        return make()
    with _lock:
        if name in _maps:
            _maps.move_to_end(name)
            _used.add(name)
            return _maps[name]
    values = _read(name, count, dtype) if where == "on" else None
    known = _joined(each, some, count) if values is None and each and some else None
    _make_room(limit - size)
    result = make() if values is None and known is None else make(known if values is None else values)
    if where == "on" and values is None and _written and size <= LARGEST_FILE:
        _write(name, result.values, dtype)
    if size <= limit:
        with _lock:
            _maps[name] = result
            _used.add(name)
            if each:
                _lights[name] = each
    return result


def _joined(each: list, some, count: int) -> np.ndarray | None:
    """The `count` numbers of a map of the lights `each`: from the map in memory that has most of them, and of the rest,
    if there is one, by ``some(rows)``; None where no map has any."""
    with _lock:
        maps, found = dict(_maps), dict(_lights)
    places: dict[str, dict] = {name: {light: i for i, light in enumerate(has)} for name, has in found.items()}
    best = max(places, key=lambda name: sum(light in places[name] for light in each), default=None)
    if best is None or not any(light in places[best] for light in each):
        return None
    have = np.array([places[best].get(light, -1) for light in each])
    values = np.empty((len(each), count // len(each)), np.float32)
    values[have >= 0] = maps[best].values.reshape(-1, values.shape[1])[have[have >= 0]]
    missing = np.flatnonzero(have < 0)
    if len(missing):
        values[missing] = some(missing).values.reshape(len(missing), -1)
    return values.ravel()


@contextmanager
def not_written() -> Iterator[None]:
    """Within, maps are read from disk, but none is written there: lights of a film that move leave one a frame."""
    global _written
    before, _written = _written, False
    try:
        yield
    finally:
        _written = before


def forget() -> None:
    """Drop what is kept in memory."""
    with _lock:
        _maps.clear()
        _forget_gone()


def keep_used() -> None:
    """Drop from memory what was not used since the last call: of frames, lights that have moved on leave no maps
    behind, and all others keep theirs."""
    with _lock:
        for name in set(_maps) - _used:
            del _maps[name]
        _used.clear()
        _forget_gone()


def _make_room(limit: float) -> None:
    """Drop the maps used longest ago until the others take `limit` bytes at most."""
    with _lock:
        while _maps and sum(m.texels.nbytes for m in _maps.values()) > limit:
            _maps.popitem(last=False)
        _forget_gone()


def _forget_gone() -> None:
    """Drop the entries of maps that are no longer in memory. The caller holds the lock."""
    _used.intersection_update(_maps)
    for name in set(_lights) - set(_maps):
        del _lights[name]


def _folder() -> Path:
    """The cache's, out of which or into which a file has just gone."""
    where = user_cache.folder()
    assert where is not None
    return where


def _file(name: str) -> str:
    return f"maps/{name}.map"


def _seal(name: str, values: np.ndarray) -> bytes:
    digest = hashlib.sha256(name.encode())
    digest.update(values.data)
    return digest.digest()


def _read(name: str, count: int, dtype: np.dtype = FULL):
    content = user_cache.read(_file(name), SEAL + dtype.itemsize * count)
    if content is None:
        return None
    values = np.frombuffer(content, dtype, offset=SEAL)
    if content[:SEAL] != _seal(name, values):
        return None
    with suppress(OSError):
        os.utime(_folder() / _file(name))
    return values


def _write(name: str, values: np.ndarray, dtype: np.dtype = FULL) -> None:
    values = np.ascontiguousarray(values, dtype)
    if np.isfinite(values).all() and user_cache.write(_file(name), _seal(name, values), values):
        with suppress(OSError):  # of other processes that tidy up as well
            _tidy(_folder() / "maps")


def _tidy(where: Path) -> None:
    """Remove the files used longest ago until the folder is within its limit."""
    files = sorted(((f.stat().st_mtime, f.stat().st_size, f) for f in where.iterdir()), reverse=True)
    total = 0
    for _, size, file in files:
        total += size
        if total > FOLDER_LIMIT:
            file.unlink(missing_ok=True)
