"""From a method's name, a medium and its lights to the object whose ``tau`` answers for them: the one place that knows
what each method of :mod:`mi_ntf.infer.visibility` is built from. Integrator and ``ntf`` emitter share it."""

import math
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer import profile
from ...infer.visibility import (
    map_source,
    neural_transmittance,
    raymarch,
    transmittance_map,
    transmittance_volume,
    visibility_mlp,
)
from . import map_cache, map_file


@dataclass(frozen=True)
class Options:
    """`step`: length of the camera march's cells, field units; `map_resolution`: texels along a map's side;
    `map_source`: ``field`` or ``network``; `map_components`: logistics a texel that the field's march is fitted by, 1
    or 2 (the network has its own number); `map_memory`: MiB that the maps or volumes of one part of the lights may
    take; `map_file`: EXR of `mi-ntf bake` that holds the maps, or none; `cache`: maps are kept for the next frame and
    on disk (:mod:`mi_ntf.render.maps.map_cache`)."""

    step: float
    map_resolution: int = 192
    map_source: str = "field"
    map_components: int = 1
    map_memory: float = 1024.0
    map_file: str = ""
    cache: bool = False


def options(integrator) -> Options:
    """The options of an ``nrf`` integrator."""
    wanted = ("map_resolution", "map_source", "map_components", "map_memory", "map_file")
    found = {name: getattr(integrator, name) for name in wanted if hasattr(integrator, name)}
    return Options(2 / integrator.samples, **found, cache=True)


def parts(method: str, media, table, options: Options) -> list:
    """``(first, last)`` of runs of lights whose maps or volumes, of all `media`, fit into `map_memory`; one run for
    methods that hold nothing per light. Raises MiNtfError where not even one light fits."""
    size = max(size_per_light(method, medium, table, options) for medium in media)
    if not size or not table.count:
        return [(0, table.count)]
    # Dr.Jit counts entries in 32 bits.
    count = int(min(options.map_memory * 2**20 / (size * len(media)), (2**32 - 1) / (size / 4)))
    if count < 1:
        raise MiNtfError(
            f"map_memory is {options.map_memory:.4g} MiB, but one light takes {size * len(media) / 2**20:.4g} MiB "
            f"({method}, map_resolution {options.map_resolution}, {len(media)} media); raise map_memory or lower "
            "map_resolution"
        )
    return [(first, min(first + count, table.count)) for first in range(0, table.count, count)]


def size_per_light(method: str, medium, table, options: Options) -> int:
    """Bytes of one light's map or volume; 0 for methods that hold nothing per light."""
    if method not in ("transmittance_map", "transmittance_volume"):
        return 0
    return 4 * _numbers(method, medium, table, options) * options.map_resolution**2


def _numbers(method: str, medium, table, options: Options) -> int:
    """float32 numbers that a light's ray takes."""
    if method == "transmittance_volume":
        return _depths(options)
    if options.map_source == "field":
        return transmittance_map.channels(options.map_components)
    components = medium.field.network.components
    return transmittance_map.channels(components, components > 1 or _inside(table))


def _depths(options: Options) -> int:
    """Entries of a ray of a transmittance volume."""
    return math.ceil(transmittance_volume.ENTRIES * 2 / options.step)


def _inside(table) -> bool:
    """Whether some light lies inside the sphere."""
    return bool((table.is_point & (np.linalg.norm(table.where, axis=1) < 1)).any())


def build(method: str, medium, table, options: Options):
    """The visibility `method` (never ``auto``) of `medium`, in its field coordinates; None for ``none``.

    `table`: the :class:`mi_ntf.infer.lights.LightTable` of the same coordinates, which maps and volumes are made for,
    and whose moving lights a march follows more finely; None serves the others.
    """
    source, field = medium.source, medium.field
    if method == "none":
        return None
    if method == "raymarch":
        steps = raymarch.default_steps(options.step, gradients=table is not None and table.moving)
        return raymarch.RayMarch(source.density, field.grid, tuple(dr.opaque(mi.Float, s) for s in steps))
    if method == "visibility_mlp":
        return visibility_mlp.VisibilityMLP(field.network)
    if method == "transmittance_volume":
        depths = _depths(options)
        return transmittance_volume.TransmittanceVolume(
            table, options.map_resolution, depths, field.grid.hull, source.density, mi
        )
    network = method == "neural_transmittance" or options.map_source == "network"
    # Two logistics follow a ray closely enough for the march's own error to show.
    step = options.step * (profile.FOR_NETWORKS if network else profile.FOR_MAPS / options.map_components)
    reader = profile.DepthProfile(source.density, field.grid, dr.opaque(mi.Float, step))
    if method == "neural_transmittance":
        return neural_transmittance.NeuralTransmittance(field.network, reader)
    made_by = (
        map_source.network_source(field.network, reader, _inside(table))
        if network
        else map_source.field_source(source, reader, options.map_components)
    )

    def make(values=None):
        values = None if values is None else mi.Float(values)
        return transmittance_map.TransmittanceMap(table, options.map_resolution, field.grid.hull, made_by, mi, values)

    width = _numbers(method, medium, table, options)
    if options.map_file:
        path = Path(str(mi.file_resolver().resolve(options.map_file)))
        return make(map_file.read(path, medium, table, options, width))
    if not options.cache:
        return make()
    name = map_cache.key(medium, table, options, width, step)
    # Of several runs of lights, each needs all of the memory, and none of their maps comes again in this picture.
    limit = options.map_memory * 2**20 if table.count == table.total else 0
    return map_cache.cached(name, make, table.count * options.map_resolution**2 * width, limit)
