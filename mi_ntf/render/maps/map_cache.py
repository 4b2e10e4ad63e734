"""Transmittance maps that are made once: kept in memory over frames, on disk over runs.

A map's key is everything that its texels depend on: the field's content, grid and marching step, the lights' places,
resolution, source and number of logistics (:mod:`mi_ntf.render.user_cache`).
"""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from .. import user_cache

# Guards `_maps`, `_lights` and `_used`. It is not held while a map is made, since a thread that waits for the map's
# kernels may execute a task that makes another map.
_lock = threading.Lock()
_maps: OrderedDict[str, Any] = OrderedDict()
_lights: dict[str, list] = {}
"""Of those that say it, what each of their lights is called (:func:`lights`)."""
_used: set[str] = set()
"""Names of maps in memory that were asked for since :func:`keep_used` was called last."""


def key(medium, table, options, width: int, step: float) -> str:
    """Name of the map of `table`'s lights; `width`: numbers a texel; `step`: of the march that makes it, field
    units."""
    facts = _facts(medium, options, width, step)
    return user_cache.key(facts, table.where, table.is_point, medium.field.grid.hull)


def _facts(medium, options, width: int, step: float) -> tuple:
    """Return the inputs of the texels besides the lights and the hull, which is the field's."""
    return (
        medium.field.digest, medium.representation, medium.field.grid.resolution, options.step, step,
        options.map_resolution, options.map_source, options.map_components, width,
    )


def lights(medium, table, options, width: int, step: float) -> list:
    """A name for the map of each light of `table` by itself."""
    facts = _facts(medium, options, width, step)
    rows = zip(table.where, table.is_point, strict=True)
    return [(facts, where.tobytes(), bool(is_point)) for where, is_point in rows]


def cached(name: str, make, count: int, limit: float, each: list | None = None, some=None, kind: type = np.float32,
           placed: bool = True):
    """The map called `name`, of `count` numbers of NumPy's `kind`: from memory, else ``make(values)`` of those in its
    file, else ``make()``, which is then kept on disk.

    `limit`: bytes that maps in memory may take, this one and its making included; a map that takes more is not kept
    there. `placed`: it depends on where lights are. `each`: :func:`lights`, where a map in memory may hold some of them
    already; ``some(rows)`` then makes the map of the others.
    """
    where, dtype = user_cache.mode(), np.dtype(kind)
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
    if where == "on" and values is None:
        texels = np.asarray(result.values, dtype)
        if np.isfinite(texels).all():
            user_cache.write("maps", name, {"texels": texels}, placed)
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
def in_memory() -> Iterator[None]:
    """Keep maps in memory and in no file within the block, which begins and ends without any."""
    with user_cache.switched("memory"):
        forget()
        try:
            yield
        finally:
            forget()


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


def _read(name: str, count: int, dtype: np.dtype) -> np.ndarray | None:
    """Return the `count` numbers of a map on the disk."""
    texels = (user_cache.read("maps", name) or {}).get("texels")
    return texels if texels is not None and texels.shape == (count,) and texels.dtype == dtype else None
