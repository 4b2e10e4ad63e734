"""Fields, surfaces and lights of a scene, prepared for one render.

Camera rays go through them in :mod:`mi_ntf.render.transport.camera_light`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple, cast

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer import march, shade
from ...infer.backend import module_of
from ...infer.bundle import Strand
from ...infer.lights import LightTable
from ...infer.phase_function import HenyeyGreenstein, smoke
from ...infer.types import Float, Mask, Ray, UInt32, Vector3, Visibility
from ...infer.visibility import REGISTRY
from ...infer.visibility.attached_shadow import AttachedDepth, AttachedShadow
from ...infer.visibility.raymarch import RayMarch
from ...infer.visibility.unbiased import Unbiased
from .. import log, timing
from ..lights import scene_lights
from ..maps import building
from ..scene import many
from ..scene.media import NRFMedium, find_media, ordinary_shapes
from ..scene.settings import Settings
from ..scene.traversal import traverse
from . import effects
from .bounced import Bounced, Patches
from .shadow import FieldVisibility, KnownTransmittance, Part, Shadow, transmittance_between
from .surfaces import Surfaces

IN_SMOKE = 4
"""Factor by which fewer camera rays are in flight where they meet smoke, since each ray has more samples."""

JOINABLE = ("auto", "raymarch", "transmittance_atlas", "none")
"""Visibility methods that serve all instances of a field, since they store nothing for a single light."""
Run = tuple[int, int] | None
"""Rows (first, end) of the light table whose maps are in memory at once; None: all rows."""


class SceneStrands(NamedTuple):
    """Strands of scene rays, one for each part; `unit`: scene length of the unit of their parameter t."""

    strands: list[Strand]
    unit: Float


def _may_join(scene: mi.Scene, settings: Settings) -> bool:
    """Return True if many instances of a field may be one medium.

    Derivatives need loops that are not nested. Patches of radiosity and corrections of an unbiased render belong to
    single fields.
    """
    attached = any(dr.grad_enabled(value) for _, value in traverse(scene))
    return (settings.visibility in JOINABLE and not settings.unbiased and not settings.map_file and not attached
            and settings.bounces != "radiosity")


class Composition:
    """The scene prepared for one render. Effects that it lacks are not built (:mod:`mi_ntf.render.transport.effects`).

    patches  of an earlier render of the same fields, or None
    smoke    the camera sees a field without opaque skins
    runs     blocks of lights whose maps are in memory at once
    run      number of the present one
    """

    def __init__(self, scene: mi.Scene, settings: Settings, sensor: mi.Sensor, spp: int,
                 patches: Patches | None = None) -> None:
        self.scene, self.sensor, self.patches = scene, sensor, patches
        media = [m for i, m in enumerate(find_media(scene)) if i not in settings.without_media]
        self.lights = scene_lights.Lights(scene, media, settings.light_samples, settings.environment_lights,
                                          settings.brightest_lights, settings.only_emitters)
        self.media = media = many.joined(media) if _may_join(scene, settings) else media
        settings = building.resolved(settings, len(self.lights.rows.power), media)
        self.effects = effects.describe(scene, settings, sensor, spp, media, self.lights)
        if settings.visibility == "auto" and self.effects.needs_visibility:
            log.info(f"nrf integrator: auto takes visibility={self.effects.visibility}: {self.effects.reason}")
        self.settings = settings = replace(settings, visibility=self.effects.visibility)
        self._media_with_matter = [m for m in media if m.field.grid.majorant > 0]
        self._media_in_view = [m for m, visible in zip(media, self.effects.in_view, strict=True) if visible]
        self.smoke = not all(m.field.softness.opaque for m in self._media_in_view)
        self.parts: list[Part] = []
        self._seeded: list[Part] = []  # of single fields of many, whose lookups take random numbers
        self.in_view: list[Part] = []
        self.runs, self.run = self._runs(), -1  # none yet
        self.select(0)
        self.surfaces: Surfaces | None = None
        if self.effects.surfaces:
            shapes = ordinary_shapes(scene)
            self.surfaces = Surfaces(scene, shapes, settings.hide_emitters, self.transmittance)
        self.bounced: Bounced | None = None
        if self.effects.bounces == "radiosity" and self.parts:
            with timing.building(), self.with_all_lights():
                self.patches = patches if patches and patches.fit(self) else Patches(self)
                self.bounced = Bounced(self, self.patches, settings.max_depth)

    def _runs(self) -> list[Run]:
        """Return the runs of the table's lights, [None] if all maps fit into memory together or there are none.

        Raises MiNtfError if derivatives need more maps at once than fit.
        """
        method, media = self.effects.visibility, self._media_with_matter
        if not media or not self.effects.lit or not self.effects.needs_visibility:
            return [None]
        table = self.lights.table(media[0].frame)
        runs: list[Run] = [*building.parts(method, media, table, self.settings)]
        if self.effects.gradients and len(runs) > 1:
            size = sum(building.size_per_light(method, m, table, self.settings) for m in media)
            raise MiNtfError(
                f"map_memory is {self.settings.map_memory:.4g} MiB, but derivatives need the maps of all {table.count} "
                f"lights at once, {size * table.count / 2**20:.4g} MiB ({method}); raise map_memory or "
                "choose visibility=raymarch, which holds none"
            )
        return [None] if self.effects.gradients else runs

    def select(self, run: int) -> None:
        """Prepare the lights of run `run`.

        The first run has everything else that shines, too, and multiple scattering of all lights. Later runs have these
        lights alone, which fields scatter once.
        """
        if run == self.run:
            return
        # Frees the old maps before new ones are built.
        self.run, self.parts, self.in_view, self._seeded = run, [], [], []
        self.parts = [self._part(m) for m in self._media_with_matter]
        self.in_view = [p for p in self.parts if p.medium in self._media_in_view]

    def _part(self, medium: NRFMedium) -> Part:
        if not isinstance(medium, many.Crowd):
            return self._part_of(medium)
        parts, table = [self._part_of(m) for m in medium.kinds], self.lights.table(medium.frame)
        self._seeded += parts
        return Part(cast(NRFMedium, medium), table, table, medium.visibility([p.for_run for p in parts]),
                    medium.visibility([p.for_sampled for p in parts]), medium.visibility([p.for_all for p in parts]))

    def _part_of(self, medium: NRFMedium) -> Part:
        """Return the medium with the visibility of its lights; one that carries gradients is marched."""
        log_density = medium.attached_log_density
        if log_density is None:
            return self._detached_part(medium)
        march = cast(RayMarch, building.march(medium, None, building.options(self.settings, medium)))
        depth = AttachedDepth(march, log_density)
        if not self.effects.lit or self.effects.visibility == "none" or self.settings.shadow_gradients == "none":
            return replace(self._detached_part(medium), depth=depth)
        shadow = AttachedShadow(depth)
        return Part(medium, *self._tables(medium), shadow, shadow, shadow, depth)

    def _tables(self, medium: NRFMedium) -> tuple[LightTable, LightTable]:
        """Return the table of all lights in the medium's field coordinates, and its rows of the present run."""
        all_lights, run = self.lights.table(medium.frame), self.runs[self.run]
        return all_lights, all_lights.part(*run) if run and len(self.runs) > 1 else all_lights

    def _detached_part(self, medium: NRFMedium) -> Part:
        all_lights, table = self._tables(medium)
        if not self.effects.lit or not self.effects.needs_visibility:
            return Part(medium, all_lights, all_lights)
        options = building.options(self.settings, medium)
        for_sampled = REGISTRY[self.effects.visibility].for_sampled
        if table.moving and not REGISTRY[for_sampled].derivatives:
            for_sampled = "raymarch"
        method = self.effects.visibility if table.count else for_sampled  # there are no maps of no light
        visibility = building.build(method, medium, table, options)
        if self.settings.unbiased and REGISTRY[method].numbers:
            march = building.build("raymarch", medium, table, options)
            assert visibility and march
            visibility = Unbiased(visibility, march, self._media_with_matter.index(medium), mi)
        if for_sampled != method:
            other = building.build(for_sampled, medium, table, options)
            return Part(medium, all_lights, table, visibility, other, other)
        if not REGISTRY[method].per_field:
            return Part(medium, all_lights, table, visibility, visibility, visibility)
        assert visibility
        suns = self.lights.suns()
        of_sampled = building.with_suns(visibility, None, medium, table, options)
        of_table = building.with_suns(visibility, suns, medium, table, options) if suns.any() else visibility
        return Part(medium, all_lights, table, of_table, of_sampled, of_table)

    def seed_lookups(self, stream: UInt32) -> None:
        """Set the opaque seed of visibility methods whose lookups take random numbers."""
        for part in self.parts + self._seeded:
            for method in (part.for_run, part.for_sampled):
                while method:
                    if hasattr(method, "stream"):
                        method.stream = stream
                    method = getattr(method, "looked_up", None)

    @contextmanager
    def with_all_lights(self) -> Iterator[None]:
        """Light the fields by the lights of all runs within the block."""
        parts = self.parts
        if len(self.runs) > 1:
            self.parts = [replace(p, table=p.all_lights, for_run=p.for_all) for p in parts]
        try:
            yield
        finally:
            self.parts = parts

    def transmittance(self, p: Vector3, d: Vector3, distance: Float, active: Mask, sun: Mask = False) -> Float:
        """Return the transmittance of the fields from the scene points `p` along `d`, as far as `distance`.

        `sun`: the light is :func:`mi_ntf.render.lights.emitter_samples.sharp`.
        """
        tau = mi.Float(1)
        for part in self.parts:
            if part.for_sampled:
                field = FieldVisibility(part.frame, part.for_sampled)
                tau = tau * transmittance_between(field, p, d, distance, mi.UInt32(0), active, mi.Bool(sun))
        return tau

    def strands(self, ray: Ray, parts: Sequence[Part], most: int = 0) -> SceneStrands:
        """Return the strands of scene rays through `parts`.

        `most`: see :func:`mi_ntf.render.maps.building.fewer_samples`; 0: cells are as long as the settings say.
        """
        several = len(parts) > 1
        unit = min(p.frame.length for p in parts)
        strands = [
            Strand(
                p.source,
                p.frame.point_to_field(ray.o),
                p.frame.direction_to_field(ray.d),
                dr.opaque(mi.Float, p.finest * (2 / building.fewer_samples(self.settings, p.medium, most)
                                                if most else building.options(self.settings, p.medium).step)),
                dr.opaque(mi.Float, unit / p.frame.length) if several else None,
            )
            for p in parts
        ]
        return SceneStrands(strands, dr.opaque(mi.Float, unit))

    def free_flight(self, ray: Ray, maxt: Float, offset: Float, depths: Sequence[Float],
                    most: int) -> tuple[Mask, Float, UInt32]:
        """Return ``(hit, t, part)`` of :func:`mi_ntf.infer.march.free_flight` through all fields, t in scene lengths.

        `most`: as for :meth:`strands`.
        """
        strands, unit = self.strands(ray, self.parts, most)
        hit, t, index = march.free_flight(strands, maxt / unit, offset, depths)
        return hit, t * unit, index

    def reflect(self, part: Part, points: shade.Points, stream: UInt32, view: Float | None = None, *,
                surface: bool = False, light_samples: int = 0) -> list[Float]:
        """Return the radiance that points of `part` reflect from all lights.

        Parameters
        ----------
        stream
            Opaque seed of sampled lights.
        view
            Transmittance of the points, if lights at the camera share it.
        surface
            The points lie on a diffuse surface above the skin.
        light_samples
            Least number of sampled lights.
        """
        total = [dr.zeros(mi.Float, dr.width(points.x[0])) for _ in range(3)]
        for source, mapped in self.lights.sources(part.table, part.frame, points, stream, light_samples,
                                                  self.effects.gradients):
            if self.run and not mapped:
                continue
            # Maps and volumes do not follow a light that moves.
            sampled = not mapped or part.table.moving
            shadow = KnownTransmittance(view) if view is not None else self.shadow(part, sampled, source.far)
            light = shade.reflect(points, source, shadow, self.effects.specular and not surface,
                                  self.effects.gradients, not surface)  # fmt: skip
            total = [a + b for a, b in zip(total, light, strict=True)]
        return total

    def arriving(self, part: Part, points: shade.Points, stream: UInt32) -> list[Float]:
        """Return the fraction, RGB, of the lights' irradiance from all sides that arrives at points of `part`.

        The rest is in the shadow of other fields and surfaces. It is 1 where no light would arrive. `stream`: opaque
        seed of sampled lights.
        """
        one: Float = dr.ones(mi.Float, dr.width(points.x[0]))
        white = smoke((one, one, one), HenyeyGreenstein(0, module_of(mi.Float)))
        even = shade.Points(points.x, points.wo, white, points.ray, points.ordinal)
        arriving, all_light = ([dr.zeros(mi.Float, dr.width(one)) for _ in range(3)] for _ in range(2))
        own, gradients = FieldVisibility(part.frame, KnownTransmittance(mi.Float(1))), self.effects.gradients
        for source, mapped in self.lights.sources(part.all_lights, part.frame, even, stream, 0, gradients):
            others = [FieldVisibility(p.frame, method) for p in self.parts if p.medium is not part.medium
                      and (method := p.for_all if mapped and not part.all_lights.moving else p.for_sampled)]
            shadow = Shadow(own, others, self.surfaces) if part.for_sampled else None
            for total, visibility in ((arriving, shadow), (all_light, None)):
                light = shade.reflect(even, source, visibility, False, gradients)
                total[:] = [a + b for a, b in zip(total, light, strict=True)]
        return [dr.select(total > 0, a / total, 1) for a, total in zip(arriving, all_light, strict=True)]

    def shadow(self, part: Part, sampled: bool, far: bool = False) -> Visibility | None:
        """Return the visibility of lights from points of `part` through all fields and surfaces.

        `sampled`: of sampled lights, not of those of the run; `far`: the lights lie outside of the part's sphere.
        """
        visibility = part.visibility(sampled)
        far = far and (sampled or REGISTRY[self.effects.visibility].per_field)  # a light's map needs its position
        other_fields = [FieldVisibility(p.frame, method) for p in self.parts
                        if p is not part and (method := p.visibility(sampled))]
        if visibility and (other_fields or self.surfaces or far):
            return Shadow(FieldVisibility(part.frame, visibility), other_fields, self.surfaces, far)
        return visibility
