"""Cache of transmittance maps: in memory for the next frame, on disk for the next process.

The key of a map covers all inputs of its texels: the field's content, grid and marching step, the lights' places,
resolution, source and number of logistics (:mod:`mi_ntf.render.user_cache`).
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from ...infer.lights import LightTable
from ...infer.visibility.method import Options
from ...infer.visibility.transmittance_map import TransmittanceMap
from .. import user_cache
from ..scene.media import NRFMedium

# Guards `_maps`, `_light_keys` and `_used`. It is not held while a map is made, since a thread that waits for the map's
# kernels may execute a task that makes another map.
_lock = threading.Lock()
_maps: OrderedDict[str, TransmittanceMap] = OrderedDict()
FLOAT32 = np.dtype(np.float32)
FORMAT = 2
"""Number of the meaning of texels. 2: atlases of smoke hold optical depths. Stored maps of another are made anew."""
LightKey = tuple[str, bytes, bool]
_light_keys: dict[str, list[LightKey]] = {}
"""Name of a map → key of each of its lights, for maps that can be reused light by light."""
_used: set[str] = set()
"""Names of the maps in memory that were requested since the last call of :func:`keep_used`."""


def description(medium: NRFMedium, options: Options) -> dict[str, object]:
    """Return the inputs of a map apart from its lights, as a map file records them."""
    return {"field": medium.field.digest, "representation": medium.representation,
            "grid": medium.field.grid.resolution, "map_resolution": options.map_resolution,
            "map_source": options.map_source, "map_components": components(medium, options),
            "samples": 2 / options.step, "texel_format": FORMAT}


def components(medium: NRFMedium, options: Options) -> int:
    """Return the number of logistics of a texel."""
    return medium.field.network.components if options.map_source == "network" else options.map_components


def key(medium: NRFMedium, lights: LightTable, options: Options, channels: int, step: float) -> str:
    """Return the name of the map of `lights`.

    `channels`: numbers of a texel; `step`: step of the march that fills the map, in field units.
    """
    return user_cache.key(description(medium, options), channels, step, lights.where, lights.is_point,
                          medium.field.grid.hull)


def light_keys(medium: NRFMedium, lights: LightTable, options: Options, channels: int, step: float
               ) -> list[LightKey]:
    """Return a key for the part of the map that belongs to each of `lights`; see :func:`key`."""
    inputs = repr((description(medium, options), channels, step))
    rows = zip(lights.where, lights.is_point, strict=True)
    return [(inputs, where.tobytes(), bool(is_point)) for where, is_point in rows]


def cached(name: str, make: Callable[..., TransmittanceMap], count: int, limit: float, *,
           light_keys: list[LightKey] | None = None, make_part: Callable[[np.ndarray], TransmittanceMap] | None = None,
           dtype: np.dtype = FLOAT32, placed: bool = True) -> TransmittanceMap:
    """Return the map called `name` from memory or disk; make and store it if it is in neither.

    make          makes the map: ``make()`` computes the texels, ``make(values)`` takes stored ones
    count, dtype  number and type of the map's numbers
    limit         bytes that maps in memory may take, this one included; a larger map is not stored there
    light_keys    :func:`light_keys`, if parts of a map in memory may be reused
    make_part     ``make_part(rows)`` makes the map of some lights
    placed        the map depends on the places of lights
    """
    mode, size = user_cache.mode(), dtype.itemsize * count
    if mode == "off":
        return make()
    with _lock:
        if name in _maps:
            _maps.move_to_end(name)
            _used.add(name)
            return _maps[name]
    stored = _read(name, count, dtype) if mode == "on" else None
    values = stored
    if stored is None and light_keys and make_part:
        values = _joined(light_keys, make_part, count)
    _make_room(limit - size)
    result = make() if values is None else make(values)
    if mode == "on" and stored is None:
        texels = np.asarray(result.values, dtype)
        if np.isfinite(texels).all():
            user_cache.write("maps", name, {"texels": texels}, placed)
    if size <= limit:
        with _lock:
            _maps[name] = result
            _used.add(name)
            if light_keys:
                _light_keys[name] = light_keys
    return result


def _joined(light_keys: list[LightKey], make_part: Callable[[np.ndarray], TransmittanceMap], count: int
            ) -> np.ndarray | None:
    """Return the `count` numbers of a map: of most lights from a map in memory, of the others by ``make_part(rows)``.

    Returns None if no map in memory has any of the lights.
    """
    with _lock:
        maps, keys = dict(_maps), dict(_light_keys)
    places = {name: {light: i for i, light in enumerate(lights)} for name, lights in keys.items()}
    best = max(places, key=lambda name: sum(light in places[name] for light in light_keys), default=None)
    if best is None or not any(light in places[best] for light in light_keys):
        return None
    source = np.array([places[best].get(light, -1) for light in light_keys])
    values = np.empty((len(light_keys), count // len(light_keys)), np.float32)
    values[source >= 0] = maps[best].values.reshape(-1, values.shape[1])[source[source >= 0]]
    missing = np.flatnonzero(source < 0)
    if len(missing):
        values[missing] = make_part(missing).values.reshape(len(missing), -1)
    return values.ravel()


@contextmanager
def in_memory() -> Iterator[None]:
    """Store maps in memory alone within the block, which begins and ends with an empty cache."""
    with user_cache.switched("memory"):
        forget()
        try:
            yield
        finally:
            forget()


def forget() -> None:
    """Remove all maps from memory."""
    with _lock:
        _maps.clear()
        _forget_removed()


def keep_used() -> None:
    """Remove the maps from memory that were not used since the last call, such as those of lights that have moved."""
    with _lock:
        for name in set(_maps) - _used:
            del _maps[name]
        _used.clear()
        _forget_removed()


def _make_room(limit: float) -> None:
    """Remove the least recently used maps until the others take `limit` bytes at most."""
    with _lock:
        while _maps and sum(m.texels.nbytes for m in _maps.values()) > limit:
            _maps.popitem(last=False)
        _forget_removed()


def _forget_removed() -> None:
    """Remove the entries of maps that are no longer in memory. The caller holds the lock."""
    _used.intersection_update(_maps)
    for name in set(_light_keys) - set(_maps):
        del _light_keys[name]


def _read(name: str, count: int, dtype: np.dtype) -> np.ndarray | None:
    """Return the `count` numbers of a map on disk."""
    texels = (user_cache.read("maps", name) or {}).get("texels")
    return texels if texels is not None and texels.shape == (count,) and texels.dtype == dtype else None
