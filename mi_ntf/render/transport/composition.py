"""Fields, surfaces and lights of a scene, prepared for one render: what hides, shades and dims what. Camera rays go
through them in :mod:`mi_ntf.render.transport.camera_light`."""

import itertools
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer import march, shade
from ...infer.bundle import Strand
from ...infer.visibility import REGISTRY
from ...infer.visibility.marched_suns import DRAWN
from ...infer.visibility.unbiased import Unbiased
from .. import log, timing
from ..lights import scene_lights
from ..maps import building
from ..scene import effects
from ..scene.media import find_media, ordinary_shapes
from ..scene.settings import Settings
from .bounced import Bounced, Patches
from .shadow import Known, Shadow, between
from .surfaces import Surfaces

IN_SMOKE = 4
"""Times as many samples have rays that meet smoke: so many times fewer are in flight."""


@dataclass(frozen=True)
class Part:
    """An ``nrf`` medium prepared for a render.

    lights   all lights, in the medium's field coordinates; `table`: those of the present run
    mapped   visibility of the table's lights; None: no shadows
    drawn    visibility of lights that are drawn at random, and of any other rays
    every    visibility of all lights
    """

    medium: Any
    lights: Any
    table: Any
    mapped: Any
    drawn: Any
    every: Any

    @property
    def frame(self):
        return self.medium.frame

    @property
    def source(self):
        return self.medium.source


class Composition:
    """The scene prepared for one render. What it lacks is not built (:mod:`mi_ntf.render.scene.effects`). `patches`:
    of an earlier render of the same fields, None unless they are needed. `smoke`: the camera sees what has no opaque
    skin."""

    def __init__(self, scene, settings: Settings, sensor, spp: int, patches: Patches | None = None):
        self.scene, self.settings, self.sensor, self.patches = scene, settings, sensor, patches
        self.media = media = [m for number, m in enumerate(find_media(scene)) if number not in settings.without]
        self.lights = scene_lights.Lights(scene, media, settings.light_samples, settings.environment_lights,
                                          settings.brightest, settings.only)
        self.settings = settings = building.resolved(settings, len(self.lights.rows.power), media)
        self.effects = effects.describe(scene, settings, sensor, spp, media, self.lights)
        if settings.visibility == "auto" and self.effects.needs_visibility:
            log.info(f"nrf integrator: auto takes visibility={self.effects.visibility}: {self.effects.reason}")
        self.settings = settings = settings.but(visibility=self.effects.visibility)
        self._media = [m for m in media if m.field.grid.majorant > 0]
        self._seen = [m for m, visible in zip(media, self.effects.in_view, strict=True) if visible]
        self.smoke = not all(m.field.softness.opaque for m in self._seen)
        self.runs, self.run = self._runs(), -1  # none yet
        self.own = self._own()
        self.select(self.own[0] if self.own else 0)
        self.surfaces = None
        if self.effects.surfaces:
            shapes = ordinary_shapes(scene)
            self.surfaces = Surfaces(scene, shapes, settings.hide_emitters, self.transmittance)
        self.bounced = None
        if self.effects.bounces == "radiosity" and self.parts and 0 in self.own:
            with timing.building():
                found = patches if patches and patches.of(self) else Patches(self)
                self.bounced = self.with_all_lights(lambda: Bounced(self, found, settings.max_depth))
                self.patches = found

    def _runs(self) -> list:
        """Runs of the table's lights, (first, last), whose maps fit into memory together; [None] for all at once, as
        where maps are not made. Raises MiNtfError where derivatives need more maps at once than fit."""
        found = self.effects
        if not self._media or not found.lit or not found.needs_visibility:
            return [None]
        table = self.lights.table(self._media[0].frame)
        options = building.options(self.settings)
        runs = [(first + a, first + b) for first, last in self._shares(table.count)
                for a, b in building.parts(found.visibility, self._media, table.part(first, last), options)]
        if found.gradients and len(runs) > 1:
            size = sum(building.size_per_light(found.visibility, m, table, options) for m in self._media)
            raise MiNtfError(
                f"map_memory is {options.map_memory:.4g} MiB, but derivatives need the maps of all {table.count} "
                f"lights at once, {size * table.count / 2**20:.4g} MiB ({found.visibility}); raise map_memory or "
                "choose visibility=raymarch, which holds none"
            )
        return [None] if found.gradients else runs

    def _shares(self, count: int) -> list:
        """Rows (first, last) of each part of the lights that has some; part 0 is always there."""
        parts = self.settings.share[1]
        ends = [-(-count * i // parts) for i in range(parts + 1)]
        return [(a, b) for i, (a, b) in enumerate(itertools.pairwise(ends)) if b > a or i == 0]

    def _own(self) -> list:
        """Return the numbers of the runs that this part of the lights renders, all unless the settings say otherwise.
        """
        part, parts = self.settings.share
        if parts == 1 or self.runs == [None]:
            return [] if part else list(range(len(self.runs)))
        count = self.runs[-1][1]
        begin, end = (-(-count * i // parts) for i in (part, part + 1))
        return [k for k, (first, _) in enumerate(self.runs) if begin <= first < end or (k == 0 and part == 0)]

    def select(self, run: int) -> None:
        """Prepare the lights of run `run`: the first adds all else that shines as well, later ones these lights alone,
        where fields scatter them once. Further bounces ask for all lights in the first run."""
        if run == self.run:
            return
        self.run, self.parts, self.in_view = run, [], []  # lets go of the maps before others are made
        self.parts = [self._part(m) for m in self._media]
        self.in_view = [p for p in self.parts if p.medium in self._seen]

    def _part(self, medium) -> Part:
        found = self.effects
        whole = self.lights.table(medium.frame)
        if not found.lit or not found.needs_visibility:
            return Part(medium, whole, whole, None, None, None)
        table = whole.part(*self.runs[self.run]) if len(self.runs) > 1 else whole
        options = building.options(self.settings)
        drawn = REGISTRY[found.visibility].for_drawn
        if table.moving and not REGISTRY[drawn].derivatives:
            drawn = "raymarch"
        method = found.visibility if table.count else drawn  # maps of no light are no maps
        mapped = building.build(method, medium, table, options)
        if self.settings.unbiased and REGISTRY[method].numbers:
            march = building.build("raymarch", medium, table, options)
            mapped = Unbiased(mapped, march, self._media.index(medium), mi)
        if drawn != method:
            other = building.build(drawn, medium, table, options)
            return Part(medium, whole, table, mapped, other, other)
        if not REGISTRY[method].per_field:
            return Part(medium, whole, table, mapped, mapped, mapped)
        suns = self.lights.suns()

        def marched(suns):
            return building.with_suns(mapped, suns, medium, table, options) if suns.any() else mapped

        own = suns[table.first : table.first + table.count]
        return Part(medium, whole, table, marched(own), marched(DRAWN), marched(suns))

    def draw_from(self, stream) -> None:
        """Methods whose lookups draw numbers take them from `stream`, an opaque seed: one for each seed of the user's
        and chunk of pixels."""
        for part in self.parts:
            for method in (part.mapped, part.drawn):
                while method:
                    if hasattr(method, "stream"):
                        method.stream = stream
                    method = getattr(method, "looked_up", None)

    def transmittance(self, p, d, distance, active, sun=False):
        """Return the transmittance of the fields from scene point `p` along `d`, as far as `distance`.

        `sun`: the light is :func:`mi_ntf.render.lights.emitter_samples.sharp`.
        """
        tau = mi.Float(1)
        for part in self.parts:
            if part.drawn:
                tau = tau * between(part.frame, part.drawn, p, d, distance, mi.UInt32(sun), active)
        return tau

    def strands(self, ray, parts, steps=None):
        """``(strands, unit)`` of scene rays through `parts`: t counts in `unit`, scene lengths. `steps` across the unit
        sphere's diameter: the settings' `samples` unless told."""
        several = len(parts) > 1
        unit = min(p.frame.length for p in parts)
        result = [
            Strand(
                p.source,
                p.frame.point_to_field(ray.o),
                p.frame.direction_to_field(ray.d),
                dr.opaque(mi.Float, 2 / (steps or self.settings.samples)),
                dr.opaque(mi.Float, unit / p.frame.length) if several else None,
            )
            for p in parts
        ]
        return result, unit

    def fly(self, ray, maxt, offset, depths, steps=None):
        """:func:`mi_ntf.infer.march.free_flight` of scene rays through all fields: ``(hit, t, index)``, t in scene
        lengths from the ray's origin. `steps`: as for :meth:`strands`."""
        strands, unit = self.strands(ray, self.parts, steps)
        hit, t, index = march.free_flight(strands, maxt / unit, offset, depths)
        return hit, t * unit, index

    def with_all_lights(self, do):
        """Return ``do()``, while the lights of all runs shine."""
        parts = self.parts
        if len(self.runs) > 1:
            self.parts = [replace(p, table=p.lights, mapped=p.every) for p in parts]
        try:
            return do()
        finally:
            self.parts = parts

    def reflect(self, part: Part, points, stream, view=None, surface=False, draws: int = 0):
        """Radiance that `points` of `part` reflect from all lights; `view`: their transmittance, if lights share it;
        `surface`: whether they are diffuse points of a surface above the skin; `draws`: least number of those drawn."""
        total = [dr.zeros(mi.Float, dr.width(points.x[0])) for _ in range(3)]
        for source, mapped in self.lights.sources(part.table, part.frame, points, stream, draws,
                                                  self.effects.gradients):
            if self.run and not mapped:
                continue
            # Maps and volumes stay where the lights were.
            kind = "mapped" if mapped and not part.table.moving else "drawn"
            shadow = Known(view) if view is not None else self.shadow(part, kind, source.far)
            light = shade.reflect(points, source, shadow, self.effects.specular and not surface,
                                  self.effects.gradients, not surface)  # fmt: skip
            total = [a + b for a, b in zip(total, light, strict=True)]
        return total

    def shadow(self, part: Part, kind: str, far: bool = False):
        """Return the shadow of every field and surface at points of `part`.

        `kind`: of lights, ``mapped`` or ``drawn``; `far`: the lights lie outside of the part's sphere.
        """
        own = getattr(part, kind)
        far = far and (kind == "drawn" or REGISTRY[self.effects.visibility].per_field)  # a light's map needs its place
        others = [(p.frame, getattr(p, kind)) for p in self.parts if p is not part]
        whole = others or self.surfaces or far
        return Shadow(part.frame, own, others, self.surfaces, far) if own and whole else own
