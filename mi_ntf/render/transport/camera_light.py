"""Camera rays through a composition: radiance and opacity."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...infer import march, shade
from ..lights import environment
from .composition import Composition, Part
from .seen import Seen
from .walk import Paths, Walk


def trace(composition: Composition, ray, quadrature, stream, sums=None, seen: Seen | None = None):
    """``(radiance, opacity)`` of camera rays. `quadrature`: where their cells begin and samples lie in them
    (:meth:`mi_ntf.render.scene.camera.Camera.quadrature`). `sums`: where other outputs are gathered
    (:class:`mi_ntf.render.transport.aovs.Sums`), None where nobody asks. `seen`: what the same rays have met before, if
    anyone keeps that."""
    composition.draw_from(stream)
    return _CameraLight(composition, ray, quadrature, stream, sums, seen or Seen(keep=False)).trace()


class _CameraLight:
    """The light along rays: `hit`, the surfaces that they meet (None without surfaces); `total`, the sum so far, a
    float a ray for each channel; `met`, the samples of the fields and the scene length of their t's unit."""

    def __init__(self, composition: Composition, ray, quadrature, stream, sums, seen: Seen):
        self.scene, self.ray, self.stream, self.sums, self.seen = composition, ray, stream, sums, seen
        self.offset, self.depth = quadrature
        self.effects, self.first_run = composition.effects, not composition.run
        self.total = [dr.zeros(mi.Float, dr.width(ray.o)) for _ in range(3)]
        self.hit: Any = None
        self.met: Any = None

    def trace(self):
        surfaces, ray, found = self.scene.surfaces, self.ray, self.effects
        if surfaces:
            self.hit = surfaces.first(ray)
            dr.eval(self.hit)
        transmittance = self._fields() if self.scene.in_view else dr.ones(mi.Float, dr.width(ray.o))
        if (surfaces or found.bounces == "paths") and self.first_run:
            self.scene.with_all_lights(lambda: self._bounces(transmittance))
        opacity = 1 - transmittance
        radiance = mi.Color3f(*self.total)
        missed = True
        if self.hit is not None:
            missed = ~self.hit.is_valid()
            opacity = dr.select(missed, opacity, 1)
        if self.sums:
            self.sums.add_opacity(opacity)
            if self.hit is not None:
                self.sums.add_surface(ray, self.hit, transmittance)
        if found.background and self.first_run:
            behind = environment.seen(self.scene.scene.environment(), ray.d)
            radiance += dr.select(missed, transmittance, 0) * behind
            opacity = dr.ones(mi.Float, dr.width(ray.o))
        return radiance, opacity

    def _fields(self):
        """Adds the light that fields scatter once; returns the transmittance of the rays."""
        found, sums, ray = self.effects, self.sums, self.ray
        strands, unit = self.scene.strands(ray, self.scene.in_view)
        maxt = (dr.minimum(ray.maxt, self.hit.t) if self.hit is not None else ray.maxt) / unit
        wanted = found.lit or bool(sums and sums.needs_points)
        samples = self.seen.samples(wanted, found.collocated, lambda: march.camera_samples(
            strands, maxt, self.offset, self.depth, shade=wanted, view=found.collocated,
            shares=tuple(march.share(part.medium.field.softness.opaque) for part in self.scene.in_view)))
        self.met = samples, unit
        light = [dr.zeros(mi.Float, dr.width(samples.t)) for _ in range(3)]
        for i, part in enumerate(self.scene.in_view):
            self._field(i, part, samples, unit, light)
        if found.lit and dr.width(samples.t):
            self.total[:] = samples.totals(light, found.gradients)
        return samples.transmittance

    def _field(self, i: int, part: Part, samples, unit: float, light) -> None:
        """Adds what the samples in the field `part`, strand `i`, reflect to `light`, an array of a float a sample for
        each channel."""
        weight = samples.weights[i]
        kept: Any = None
        index, t, view = samples.ray, samples.t, samples.view
        if len(self.scene.in_view) > 1 and dr.width(index):
            kept = dr.compress(weight > 0)
            index, t, weight = (dr.gather(type(a), a, kept) for a in (index, t, weight))
            view = dr.gather(mi.Float, view, kept) if view is not None else None
        if not dr.width(index):
            return
        points = self.seen.points(samples, i, lambda: self._points(i, part, samples, index, t))
        if self.sums:
            distance = (dr.gather(mi.Float, samples.bundle.base, index) + t) * unit
            self.sums.add_field(i, part, points, samples, kept, distance, self.scene.shadow(part, "mapped"))
        if self.effects.lit:
            reflected = self._with_bounces(part, points, self.scene.reflect(part, points, self.stream, view))
            for channel, value in zip(light, reflected, strict=True):
                where = dr.arange(mi.UInt32, dr.width(t)) if kept is None else kept
                dr.scatter_reduce(dr.ReduceOp.Add, channel, value * weight, where, mode=dr.ReduceMode.NoConflicts)

    @staticmethod
    def _points(i: int, part: Part, samples, index, t) -> shade.Points:
        x, along = samples.place(i, index, t)
        points = shade.Points(x, tuple(-c for c in along), part.medium.reflectance(x))
        points.evaluate()
        return points

    def _with_bounces(self, part: Part, points, light):
        """`light` that `points` reflect of a run, and, in the first, what comes to them by way of others."""
        bounced = self.scene.bounced
        if not bounced or not self.first_run:
            return light
        return [a + b for a, b in zip(light, bounced.reflect(part, points), strict=True)]

    def _bounces(self, transmittance):
        """Adds the light of surfaces that the camera sees, and of paths of more than one bounce."""
        ray, hit, surfaces = self.ray, self.hit, self.scene.surfaces
        n = dr.width(ray.o)
        walk = Walk(self.scene, self.scene.settings.max_depth, self.total, self.stream)
        # Neighbouring sequences of one start are alike.
        start, sequence = mi.sample_tea_32(self.stream, dr.arange(mi.UInt32, n))
        rng = mi.PCG32(n, mi.UInt64(start), mi.UInt64(sequence))
        camera = Paths(mi.Ray3f(ray), mi.Color3f(transmittance), dr.arange(mi.UInt32, n), mi.Float(-1), rng)
        if surfaces:
            si = hit.compute_surface_interaction(mi.Ray3f(ray))
            if surfaces.shining:
                walk.add(camera, si.emitter(self.scene.scene).eval(si, hit.is_valid()))
        reflected = walk.on_surface(camera, si) if surfaces and self.effects.lit else None
        if not self.effects.bounces and not (surfaces and surfaces.lights_can_be_hit):
            return
        # A camera ray goes on from matter, from the surface behind it, or from both.
        onward = camera.take(dr.arange(mi.UInt32, 2 * n) % n)
        onward = replace(onward, weight=dr.zeros(mi.Color3f, 2 * n))
        if reflected:
            onward.put(reflected, dr.arange(mi.UInt32, n))
        if self.effects.bounces and self.scene.in_view:
            for index, paths in self._field_paths(walk, camera):
                onward.put(paths, index + n)
        walk.run(onward.take(dr.compress(dr.max(onward.weight) > 0)))

    def _field_paths(self, walk: Walk, camera: Paths):
        """Pairs of indices of camera rays and paths that their matter scatters on: from one of a ray's shading points,
        drawn by their weights."""
        samples, unit = self.met
        t, strand, weight = samples.draw(camera.rng.next_float32())
        t = (samples.bundle.base + t) * unit
        camera = replace(camera, weight=mi.Color3f(weight))
        dr.eval(t, strand, camera.weight, camera.rng.state)
        for i, part in enumerate(self.scene.in_view):
            index: Any = dr.compress((weight > 0) & (strand == i))
            if dr.width(index):
                yield index, walk.in_field(part, camera.take(index), dr.gather(mi.Float, t, index), 2)
