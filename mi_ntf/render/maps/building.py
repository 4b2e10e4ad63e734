"""Construction of visibility methods for the integrator and the ``ntf`` emitter.

Methods that store a table for each light are built in runs of lights that fit into `map_memory`. Their tables are taken
from a map file or from the cache if possible.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import cast

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer.backend import module_of
from ...infer.lights import LightTable
from ...infer.texels import DTYPES
from ...infer.tuning import ATLAS_RESOLUTION, SKIN_CELL
from ...infer.types import Visibility
from ...infer.visibility import REGISTRY
from ...infer.visibility.closed_form import ClosedForm
from ...infer.visibility.marched_begin import MarchedBegin
from ...infer.visibility.marched_suns import MarchedSuns
from ...infer.visibility.method import Options
from ...infer.visibility.raymarch import RayMarch
from ...infer.visibility.transmittance_map import TransmittanceMap
from .. import log, timing, user_cache
from ..scene.media import NRFMedium
from ..scene.settings import Settings
from . import map_cache

SAMPLES = 384
"""Default steps across the diameter of the unit sphere, if skins are not so thin that they need more."""
DENSE_TEXELS = 2
"""Length, in texels, of the marched part of a ray through dense smoke, whose mean free path is shorter than a texel."""
UNTRAINED = ("raymarch", "transmittance_map", "transmittance_volume", "transmittance_atlas")
"""Methods that need no trained network, which a closed form may replace."""


def resolved(settings: Settings, lights: int, media: Sequence[NRFMedium]) -> Settings:
    """Return `settings` with a `map_resolution` that suits the number of lights, and logistics that suit the media.

    Either is changed where it is 0. Smoke needs two logistics a texel, since its rays have no single skin.
    """
    opaque = all(m.field.softness.opaque for m in media)
    settings = replace(settings, map_components=settings.map_components or (1 if opaque else 2))
    if settings.map_resolution:
        return settings
    method = REGISTRY["transmittance_map" if settings.visibility == "auto" else settings.visibility]
    return replace(settings, map_resolution=method.resolution(lights, max(map(texels, media))))


def samples(medium: NRFMedium) -> int:
    """Return the default number of steps across the unit sphere of `medium`, which follow its skins.

    A field without networks has at least one for each voxel.
    """
    return max(SAMPLES, _skin_cells(medium) if medium.field.trained else medium.field.grid.resolution)


def texels(medium: NRFMedium) -> int:
    """Return the number of texels across the unit sphere that are as fine as the voxels and skins of `medium`."""
    return max(_skin_cells(medium) if medium.field.trained else 0, medium.field.grid.resolution)


def _skin_cells(medium: NRFMedium) -> int:
    """Return the number of cells across the unit sphere that resolve the skins of `medium`, at most two a voxel."""
    return min(math.ceil(2 / (SKIN_CELL * medium.field.softness.thickness)), 2 * medium.field.grid.resolution)


def fewer_samples(settings: Settings, medium: NRFMedium, most: int) -> int:
    """Return the number of steps of a march that may be coarser than that of the camera.

    `most`: number of steps where ``SAMPLES`` is the default; finer voxels take as many more. A lower number in
    `settings` holds.
    """
    fewer = most * samples(medium) // SAMPLES
    return min(fewer, settings.samples) if settings.samples else fewer


def options(settings: Settings, medium: NRFMedium) -> Options:
    """Return the options of a visibility method for `medium` under `settings`."""
    return Options(2 / (settings.samples or samples(medium)), settings.map_resolution, settings.map_source,
                   settings.map_components, map_memory=settings.map_memory, map_file=settings.map_file, cache=True)


def parts(method: str, media: Sequence[NRFMedium], table: LightTable, settings: Settings) -> list[tuple[int, int]]:
    """Return ``(first, end)`` of each run of lights whose tables, for all `media`, fit into `map_memory`.

    It is one run for methods that store nothing per light. Raises MiNtfError if not even one light fits.
    """
    size = max(size_per_light(method, medium, table, settings) for medium in media)
    if not size or not table.count:
        return [(0, table.count)]
    # Dr.Jit counts entries in 32 bits.
    count = int(min(settings.map_memory * 2**20 / (size * len(media)), (2**32 - 1) / (size / 4)))
    if count < 1:
        raise MiNtfError(
            f"map_memory is {settings.map_memory:.4g} MiB, but one light takes {size * len(media) / 2**20:.4g} MiB "
            f"({method}, map_resolution {settings.map_resolution}, {len(media)} media); raise map_memory or lower "
            "map_resolution"
        )
    return [(first, min(first + count, table.count)) for first in range(0, table.count, count)]


def size_per_light(name: str, medium: NRFMedium, table: LightTable, settings: Settings) -> int:
    """Return the bytes of one light's table under the method `name`; 0 if the method stores nothing per light."""
    method = REGISTRY[name]
    if not method.numbers or method.per_field:
        return 0
    return 4 * method.numbers(medium, table, options(settings, medium)) * settings.map_resolution**2


def size_per_field(name: str, medium: NRFMedium, table: LightTable, settings: Settings) -> int:
    """Return the bytes that the method `name` stores for a field, independently of the lights."""
    method = REGISTRY[name]
    return 4 * method.numbers(medium, table, options(settings, medium)) if method.numbers and method.per_field else 0


def build(name: str, medium: NRFMedium, table: LightTable | None, options: Options) -> Visibility | None:
    """Build the visibility method `name`, which is not ``auto``, for `medium`, in its field coordinates.

    `table`: lights in the same coordinates, for which the method stores tables; None for sampled lights. The result is
    None for ``none``. A homogeneous medium in a convex body has a closed form, which takes the place of any method.
    """

    def keep(make: Callable[..., TransmittanceMap], *, channels: int, step: float,
             directions: LightTable | None = None, options: Options = options,
             make_part: Callable[[np.ndarray], TransmittanceMap] | None = None) -> TransmittanceMap:
        lights = directions or table
        assert lights is not None  # methods for sampled lights store nothing per light
        if options.map_file:
            from . import map_file  # few renders need EXR

            return make(map_file.read(Path(log.resolve(options.map_file)), medium, lights, options, channels))
        if not options.cache:
            return make()
        # A run of several gets all of the memory, and its maps are not needed again in this picture.
        limit = options.map_memory * 2**20 if lights.count == lights.total else 0
        split = make_part is not None and limit and lights.count > 1
        field = medium.field
        # A density that was set in the scene has a name in this process alone.
        with user_cache.switched("memory") if field.density_set and user_cache.mode() == "on" else nullcontext():
            return map_cache.cached(
                map_cache.key(medium, lights, options, channels, step), make,
                lights.count * options.map_resolution**2 * channels, limit,
                light_keys=map_cache.light_keys(medium, lights, options, channels, step) if split else None,
                make_part=make_part, dtype=np.dtype(DTYPES[options.half]), placed=directions is None)

    method = REGISTRY[name]
    constant = getattr(medium.source, "constant", None)
    if constant is not None and name in UNTRAINED and options.map_source == "field" and not options.map_file:
        return ClosedForm(medium.source, constant, module_of(mi.Float))
    if not method.numbers:
        return method.build(medium, table, options, module_of(mi.Float), keep)
    size = "" if method.per_field or table is None else f", {table.count} × {options.map_resolution}² texels"
    with timing.building(), log.Work("nrf integrator", f"making the {name}{size}"):
        lookup = method.build(medium, table, options, module_of(mi.Float), keep)
    length = DENSE_TEXELS * 2 / (ATLAS_RESOLUTION if method.per_field else options.map_resolution)
    if lookup is None or medium.field.trained or medium.source.majorant * length < DENSE_TEXELS:
        return lookup
    return MarchedBegin(lookup, cast(RayMarch, march(medium, table, options)), length, module_of(mi.Float))


def march(medium: NRFMedium, table: LightTable | None, options: Options) -> Visibility:
    """Return the method ``raymarch``, which serves any light."""
    return cast(Visibility, build("raymarch", medium, table, options))


def with_suns(lookup: Visibility, suns: np.ndarray | None, medium: NRFMedium, table: LightTable | None, options: Options
              ) -> MarchedSuns:
    """Return the visibility method `lookup` with rays marched to suns.

    `suns`: mask (n,) of the rows of the light table; None for sampled lights.
    """
    return MarchedSuns(lookup, march(medium, table, options), suns, mi)
