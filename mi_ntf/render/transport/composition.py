"""Fields, surfaces and lights of a scene in one picture: what hides, shades and dims what."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer import march, shade
from ...infer.bundle import Strand
from ...infer.visibility import REGISTRY
from ..cost import measurement
from ..lights import environment, scene_lights
from ..maps import building
from ..scene import effects
from ..scene.media import find_media, ordinary_shapes
from .bounced import Bounced, Patches
from .shadow import Known, Shadow, between
from .surfaces import Surfaces
from .walk import Paths, Walk


@dataclass(frozen=True)
class Part:
    """One ``nrf`` medium prepared for a render: lights in its field coordinates, all of them (`lights`) and those of
    the present run (`table`); visibility of the table's lights and of drawn ones and any other rays (None: no
    shadows)."""

    medium: Any
    lights: Any
    table: Any
    mapped: Any
    drawn: Any

    @property
    def frame(self):
        return self.medium.frame

    @property
    def source(self):
        return self.medium.source


class Composition:
    """The scene prepared for one render. What it lacks is not built (:mod:`mi_ntf.render.scene.effects`)."""

    def __init__(self, scene, integrator, sensor, spp: int):
        self.scene, self.integrator = scene, integrator
        media = find_media(scene)
        self.lights = scene_lights.Lights(scene, media, integrator.light_samples, integrator.environment_lights)
        self.effects = effects.describe(scene, integrator, sensor, spp, media, self.lights)
        self._media = [m for m in media if m.field.grid.majorant > 0]
        self._seen = [m for m, visible in zip(media, self.effects.in_view, strict=True) if visible]
        self.runs, self.run = self._runs(), -1  # none yet
        self.select(0)
        self.surfaces = None
        if self.effects.surfaces:
            shapes = ordinary_shapes(scene)
            self.surfaces = Surfaces(scene, shapes, integrator.hide_emitters, self.transmittance)
        self._bounced = None
        if self.effects.bounces == "radiosity" and self.parts:
            with measurement.by_clock("bounces"):
                if not integrator.patches or not integrator.patches.of(self):
                    integrator.patches = Patches(self)
                self._bounced = self._with_all_lights(lambda: Bounced(self, integrator.patches, integrator.max_depth))

    def _runs(self) -> list:
        """Runs of the table's lights, (first, last), whose maps fit into memory together; [None] for all at once, as
        where maps are not made. Raises MiNtfError where derivatives need more maps at once than fit."""
        found = self.effects
        if not self._media or not found.lit or not found.needs_visibility:
            return [None]
        table = self.lights.table(self._media[0].frame)
        options = building.options(self.integrator)
        runs = building.parts(found.visibility, self._media, table, options)
        if found.gradients and len(runs) > 1:
            size = sum(building.size_per_light(found.visibility, m, table, options) for m in self._media)
            raise MiNtfError(
                f"map_memory is {options.map_memory:.4g} MiB, but derivatives need the maps of all {table.count} "
                f"lights at once, {size * table.count / 2**20:.4g} MiB ({found.visibility}); raise map_memory or "
                "choose visibility=raymarch, which holds none"
            )
        return [None] if found.gradients else runs

    def select(self, run: int) -> None:
        """Prepare the lights of run `run`: the first adds all else that shines as well, later ones these lights alone,
        where fields scatter them once. Further bounces march towards all lights in the first run."""
        if run == self.run:
            return
        self.run, self.parts, self.in_view = run, [], []  # lets go of the maps before others are made
        self.parts = [self._part(m) for m in self._media]
        self.in_view = [p for p in self.parts if p.medium in self._seen]

    def _part(self, medium) -> Part:
        found = self.effects
        whole = self.lights.table(medium.frame)
        if not found.lit or not found.needs_visibility:
            return Part(medium, whole, whole, None, None)
        table = whole.part(*self.runs[self.run]) if len(self.runs) > 1 else whole
        options = building.options(self.integrator)
        drawn = REGISTRY[found.visibility].for_drawn
        if table.moving and not REGISTRY[drawn].derivatives:
            drawn = "raymarch"
        method = found.visibility if table.count else drawn  # maps of no light are no maps
        mapped = building.build(method, medium, table, options)
        if drawn == method:
            return Part(medium, whole, table, mapped, mapped)
        return Part(medium, whole, table, mapped, building.build(drawn, medium, table, options))

    def transmittance(self, p, d, distance, active):
        """What the fields let through from scene point `p` along `d`, as far as `distance`."""
        tau = mi.Float(1)
        for part in self.parts:
            if part.drawn:
                tau = tau * between(part.frame, part.drawn, p, d, distance, mi.UInt32(0), active)
        return tau

    def strands(self, ray, parts, steps=None):
        """``(strands, unit)`` of scene rays through `parts`: t counts in `unit`, scene lengths. `steps` across the unit
        sphere's diameter: the integrator's `samples` unless told."""
        several = len(parts) > 1
        unit = min(p.frame.length for p in parts)
        result = [
            Strand(
                p.source.density,
                p.medium.field.grid,
                p.frame.point_to_field(ray.o),
                p.frame.direction_to_field(ray.d),
                dr.opaque(mi.Float, 2 / (steps or self.integrator.samples)),
                dr.opaque(mi.Float, unit / p.frame.length) if several else None,
            )
            for p in parts
        ]
        return result, unit

    def fly(self, ray, maxt, offset, depth, which, steps=None):
        """:func:`mi_ntf.infer.march.free_flight` of scene rays through all fields: ``(hit, t, index)``, t in scene
        lengths from the ray's origin. `steps`: as for :meth:`strands`."""
        strands, unit = self.strands(ray, self.parts, steps)
        hit, t, index, bundle = march.free_flight(strands, maxt / unit, offset, depth, which)
        return hit, (bundle.base + t) * unit, index

    def _with_all_lights(self, do):
        """What `do()` returns where those of other runs shine too, marched to."""
        parts = self.parts
        if len(self.runs) > 1:
            self.parts = [replace(p, table=p.lights, mapped=p.drawn) for p in parts]
        try:
            return do()
        finally:
            self.parts = parts

    def reflect(self, part: Part, points, stream, view=None, surface=False, draws: int = 0):
        """Radiance that `points` of `part` reflect from all lights; `view`: their transmittance, if lights share it;
        `surface`: whether they are diffuse points of a surface above the skin; `draws`: least number of those drawn."""
        total = [dr.zeros(mi.Float, dr.width(points.x[0])) for _ in range(3)]
        candidates = REGISTRY[REGISTRY[self.effects.visibility].for_drawn].candidates
        for source, mapped in self.lights.sources(part.table, part.frame, points, stream, draws, candidates):
            if self.run and not mapped:
                continue
            # Maps and volumes stay where the lights were.
            kind = "mapped" if mapped and not part.table.moving else "drawn"
            shadow = Known(view) if view is not None else self._shadow(part, kind)
            light = shade.reflect(points, source, shadow, self.effects.specular and not surface,
                                  self.effects.gradients, not surface)  # fmt: skip
            total = [a + b for a, b in zip(total, light, strict=True)]
        return total

    def _shadow(self, part: Part, kind: str):
        own = getattr(part, kind)
        others = [(p.frame, getattr(p, kind)) for p in self.parts if p is not part]
        return Shadow(part.frame, own, others, self.surfaces) if own and (others or self.surfaces) else own

    def trace(self, ray, quadrature, stream, sums=None):
        """``(radiance, opacity)`` of camera rays. `quadrature`: where their cells begin and samples lie in them
        (:meth:`mi_ntf.render.scene.camera.Camera.quadrature`). `sums`: where other outputs are gathered
        (:class:`mi_ntf.render.transport.aovs.Sums`), None where nobody asks."""
        n, found = dr.width(ray.o), self.effects
        total = [dr.zeros(mi.Float, n) for _ in range(3)]
        hit = None
        if self.surfaces:
            hit = self.surfaces.first(ray)
            dr.eval(hit)
        transmittance = dr.ones(mi.Float, n)
        offset, depth = quadrature
        if self.in_view:
            transmittance = self._fields(ray, hit, offset, depth, total, stream, sums)
        if (self.surfaces or found.bounces == "paths") and not self.run:
            self._with_all_lights(lambda: self._bounces(ray, hit, transmittance, offset, total, stream))
        opacity = 1 - transmittance
        radiance = mi.Color3f(*total)
        missed = True
        if hit is not None:
            missed = ~hit.is_valid()
            opacity = dr.select(missed, opacity, 1)
        if sums:
            sums.add_opacity(opacity)
            if hit is not None:
                sums.add_surface(ray, hit, transmittance)
        if found.background and not self.run:
            radiance += dr.select(missed, transmittance, 0) * environment.seen(self.scene.environment(), ray.d)
            opacity = dr.ones(mi.Float, n)
        return radiance, opacity

    def _fields(self, ray, hit, offset, depth, total, stream, sums):
        """Adds the light that fields scatter once; returns the transmittance of the rays."""
        found = self.effects
        strands, unit = self.strands(ray, self.in_view)
        maxt = (dr.minimum(ray.maxt, hit.t) if hit is not None else ray.maxt) / unit
        if found.collocated and not sums:
            total[:], transmittance = march.camera_light(strands, maxt, offset, depth, self._at_camera(strands))
            return transmittance
        wanted = found.lit or bool(sums and sums.needs_points)
        samples = march.camera_samples(strands, maxt, offset, depth, shade=wanted, view=found.collocated)
        light = [dr.zeros(mi.Float, dr.width(samples.t)) for _ in range(3)]
        for i, part in enumerate(self.in_view):
            self._field(i, part, samples, unit, light, stream, sums)
        if found.lit and dr.width(samples.t):
            total[:] = samples.totals(light, found.gradients)
        return samples.transmittance

    def _field(self, i: int, part: Part, samples, unit: float, light, stream, sums) -> None:
        """Adds what the samples in the field `part`, strand `i`, reflect to `light`, an array of a float a sample for
        each channel."""
        weight = samples.weights[i]
        kept: Any = None
        index, t, view = samples.ray, samples.t, samples.view
        if len(self.in_view) > 1 and dr.width(index):
            kept = dr.compress(weight > 0)
            index, t, weight = (dr.gather(type(a), a, kept) for a in (index, t, weight))
            view = dr.gather(mi.Float, view, kept) if view is not None else None
        if not dr.width(index):
            return
        x, along = samples.place(i, index, t)
        points = shade.Points(x, tuple(-c for c in along), part.medium.reflectance(x))
        points.evaluate()
        if sums:
            distance = (dr.gather(mi.Float, samples.bundle.base, index) + t) * unit
            sums.add_field(i, part, points, samples, kept, distance, self._shadow(part, "mapped"))
        if self.effects.lit:
            reflected = self._with_bounces(part, points, self.reflect(part, points, stream, view))
            for channel, value in zip(light, reflected, strict=True):
                where = dr.arange(mi.UInt32, dr.width(t)) if kept is None else kept
                dr.scatter_reduce(dr.ReduceOp.Add, channel, value * weight, where, mode=dr.ReduceMode.NoConflicts)

    def _at_camera(self, strands):
        """The `reflect` of :func:`mi_ntf.infer.march.camera_light` for the fields in view."""

        def reflect(i, x, view):
            part = self.in_view[i]
            points = shade.Points(x, tuple(-c for c in strands[i].d), part.medium.reflectance(x))
            light = shade.reflect(points, part.table, Known(view), self.effects.specular)
            return self._with_bounces(part, points, light)

        return reflect

    def _with_bounces(self, part: Part, points, light):
        """`light` that `points` reflect of a run, and, in the first, what comes to them by way of others."""
        if not self._bounced or self.run:
            return light
        return [a + b for a, b in zip(light, self._bounced.reflect(part, points), strict=True)]

    def _bounces(self, ray, hit, transmittance, offset, total, stream):
        """Adds the light of surfaces that the camera sees, and of paths of more than one bounce."""
        n = dr.width(ray.o)
        walk = Walk(self, self.integrator.max_depth, total, stream)
        # Neighbouring sequences of one start are alike.
        start, sequence = mi.sample_tea_32(stream, dr.arange(mi.UInt32, n))
        rng = mi.PCG32(n, mi.UInt64(start), mi.UInt64(sequence))
        camera = Paths(mi.Ray3f(ray), mi.Color3f(transmittance), dr.arange(mi.UInt32, n), mi.Float(-1), rng)
        if hit is not None:
            si = hit.compute_surface_interaction(mi.Ray3f(ray))
            if self.surfaces.shining:
                walk.add(camera, si.emitter(self.scene).eval(si, hit.is_valid()))
            if self.effects.lit:
                self._surface_paths(walk, camera, si, hit)
        if self.effects.bounces and self.in_view:
            self._field_paths(walk, camera, hit, transmittance, offset)

    def _surface_paths(self, walk, camera, si, hit):
        """Direct light on the surfaces that the camera sees, and what comes after."""
        onward = walk.on_surface(camera, si)
        if self.effects.bounces or self.surfaces.lights_can_be_hit:
            walk.run(onward.take(dr.compress(hit.is_valid() & (dr.max(onward.weight) > 0))))

    def _field_paths(self, walk, camera, hit, transmittance, offset):
        """Paths that a camera ray's matter scatters on: one collision, drawn among those that stop the ray."""
        u = [camera.rng.next_float32() for _ in range(2)]
        maxt = camera.ray.maxt if hit is None else dr.minimum(camera.ray.maxt, hit.t)
        stopped, t, which = self.fly(camera.ray, maxt, offset, -dr.log(1 - u[0] * (1 - transmittance)), u[1])
        camera = replace(camera, weight=mi.Color3f(1 - transmittance))
        dr.eval(stopped, t, which, camera.weight, camera.rng.state)
        for i, part in enumerate(self.parts):
            index = dr.compress(stopped & (which == i) & (transmittance < 1))
            if dr.width(index):
                walk.run(walk.in_field(part, camera.take(index), dr.gather(mi.Float, t, index), 2))
