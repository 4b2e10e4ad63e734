"""Visibility methods for the renderer: integrator and ``ntf`` emitter build theirs here. What is held per light is in
parts that fit into memory, and found again in files and caches."""

from pathlib import Path

import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.texels import DTYPES
from ...infer.visibility import REGISTRY
from ...infer.visibility.marched_suns import MarchedSuns
from ...infer.visibility.method import Options
from .. import log, timing
from . import map_cache


def resolved(settings, lights: int, media):
    """Return `settings` with a `map_resolution` for so many lights where it is 0."""
    if settings.map_resolution:
        return settings
    method = REGISTRY["transmittance_map" if settings.visibility == "auto" else settings.visibility]
    return settings.but(map_resolution=method.resolution(lights, max(m.field.grid.resolution for m in media)))


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
    found = REGISTRY[method]
    if not found.numbers or found.per_field:
        return 0
    return 4 * found.numbers(medium, table, options) * options.map_resolution**2


def size_per_field(method: str, medium, table, options: Options) -> int:
    """Bytes of what is held for a field, whatever the lights."""
    found = REGISTRY[method]
    return 4 * found.numbers(medium, table, options) if found.numbers and found.per_field else 0


def build(method: str, medium, table, options: Options):
    """The visibility `method` (never ``auto``) of `medium`, in its field coordinates; None for ``none``.

    `table`: the :class:`mi_ntf.infer.lights.LightTable` of the same coordinates, which maps and volumes are made for;
    None serves the others.
    """

    def keep(width: int, step: float, make, directions=None, own: Options = options, some=None):
        lights = directions or table
        if own.map_file:
            from . import map_file  # few renders need EXR

            resolver = mi.file_resolver()  # type: ignore[operator]  # an object in the stub
            path = Path(str(resolver.resolve(own.map_file)))
            return make(map_file.read(path, medium, lights, own, width))
        if not own.cache:
            return make()
        name = map_cache.key(medium, lights, own, width, step)
        # Of several runs of lights, each needs all of the memory, and none of their maps comes again in this picture.
        limit = own.map_memory * 2**20 if lights.count == lights.total else 0
        known = map_cache.lights(medium, lights, own, width, step) if some and limit and lights.count > 1 else None
        return map_cache.cached(name, make, lights.count * own.map_resolution**2 * width, limit, known, some,
                                DTYPES[own.half], directions is None)

    if not REGISTRY[method].numbers:
        return REGISTRY[method].build(medium, table, options, mi, keep)
    size = "" if REGISTRY[method].per_field else f", {table.count} × {options.map_resolution}² texels"
    with timing.building(), log.timed(f"nrf integrator: made the {method}{size}"):
        return REGISTRY[method].build(medium, table, options, mi, keep)


def with_suns(looked_up, suns, medium, table, options: Options) -> MarchedSuns:
    """`looked_up`, what :func:`build` made, with a march to those lights that are `suns`."""
    return MarchedSuns(looked_up, build("raymarch", medium, table, options), suns, mi)
