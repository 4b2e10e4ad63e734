"""Camera rays through a composition: radiance and opacity."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...infer import march, shade
from ..lights import environment
from .composition import Composition, Part
from .seen import Seen
from .surfaces import Surfaces
from .walk import Paths, Walk, join


def trace(composition: Composition, ray, quadrature, stream, sums=None, seen: Seen | None = None):
    """``(radiance, opacity)`` of camera rays. `quadrature`: where their cells begin and samples lie in them
    (:meth:`mi_ntf.render.scene.camera.Camera.quadrature`). `sums`: where other outputs are gathered
    (:class:`mi_ntf.render.transport.aovs.Sums`), None where nobody asks. `seen`: what the same rays have met before, if
    anyone keeps that."""
    composition.draw_from(stream)
    return _CameraLight(composition, ray, quadrature, stream, sums, seen or Seen(keep=False)).trace()


class _CameraLight:
    """The light along rays: `hit`, the surfaces that they meet (None without surfaces); `total`, the sum so far, a
    float a ray for each channel; `met`, the samples of the fields and the scene length of their t's unit; `crossing`,
    the rays that go straight on through the surfaces (None without any); `way`, how far the rays have come already;
    `number`, of each ray, which its random numbers follow from (None: its place)."""

    def __init__(self, composition: Composition, ray, quadrature, stream, sums, seen: Seen, way=None, number=None):
        self.scene, self.ray, self.stream, self.sums, self.seen = composition, ray, stream, sums, seen
        self.offset, self.depth = quadrature
        self.effects, self.first_run = composition.effects, not composition.run
        self.total = [dr.zeros(mi.Float, dr.width(ray.o)) for _ in range(3)]
        self.hit: Any = None
        self.met: Any = None
        self.crossing: Paths | None = None
        self.way = mi.Float(0) if way is None else way
        self.number = dr.arange(mi.UInt32, dr.width(ray.o)) if number is None else number

    def trace(self):
        surfaces, ray, found = self.scene.surfaces, self.ray, self.effects
        if surfaces:
            self.hit = surfaces.first(ray)
            dr.eval(self.hit)
        transmittance = self._fields() if self.scene.in_view else dr.ones(mi.Float, dr.width(ray.o))
        if (surfaces or found.bounces == "paths") and self.first_run:
            self.scene.with_all_lights(lambda: self._bounces(transmittance))
        elif surfaces and surfaces.transmitting:
            self._surface_paths(surfaces, self._walk(), self._camera(transmittance), lit=False)
        opacity = 1 - transmittance
        radiance = mi.Color3f(*self.total)
        missed = True
        if self.hit is not None:
            missed = ~self.hit.is_valid()
            opacity = dr.select(missed, opacity, 1)
        if self.sums:
            self.sums.add_opacity(opacity)
            if self.hit is not None:
                self.sums.add_surface(ray, self.hit, self._stopped(transmittance), self.way)
        if found.background and self.first_run:
            behind = environment.seen(self.scene.scene.environment(), ray.d)
            radiance += dr.select(missed, transmittance, 0) * behind
            opacity = dr.ones(mi.Float, dr.width(ray.o))
        if self.crossing is not None and dr.width(self.crossing.pixel):
            radiance, opacity = self._behind(self.crossing, radiance, opacity, transmittance)
        return radiance, opacity

    def _stopped(self, transmittance):
        """The part of the rays' `transmittance` that ends on the surfaces they meet."""
        if self.crossing is not None and dr.width(self.crossing.pixel):
            transmittance = mi.Float(transmittance)
            dr.scatter(transmittance, mi.Float(0), self.crossing.pixel)
        return transmittance

    def _behind(self, paths: Paths, radiance, opacity, transmittance):
        """Add what the rays that cross surfaces meet behind them: ``(radiance, opacity)`` of all rays."""
        pixel = paths.pixel
        quadrature = tuple(dr.gather(mi.Float, a, pixel) for a in (self.offset, self.depth))
        number = dr.gather(mi.UInt32, self.number, pixel)
        # Now, so that rays behind any number of surfaces are traced by the same kernels.
        dr.eval(quadrature, paths.ray, paths.weight, paths.way, pixel, number, radiance, opacity, transmittance)
        sums = self.sums and self.sums.of_rays(dr.width(pixel))
        one: Any = dr.opaque(mi.UInt32, 1)
        stream = mi.sample_tea_32(self.stream, one)[0]
        dr.make_opaque(stream)
        light, covered = _CameraLight(self.scene, paths.ray, quadrature, stream, sums, Seen(keep=False),
                                      paths.way, number).trace()
        through = dr.gather(mi.Float, transmittance, pixel)
        if self.sums:
            self.sums.add_behind(sums, through, pixel)
        for channel, value in zip(radiance, light * paths.weight, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, channel, value, pixel, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(opacity, 1 - through * (1 - covered), pixel)
        return radiance, opacity

    def _fields(self):
        """Adds the light that fields scatter once; returns the transmittance of the rays."""
        found, sums, ray = self.effects, self.sums, self.ray
        strands, unit = self.scene.strands(ray, self.scene.in_view)
        maxt = (dr.minimum(ray.maxt, self.hit.t) if self.hit is not None else ray.maxt) / unit
        wanted = found.lit or bool(sums and sums.needs_points)
        samples = self.seen.samples(wanted, found.collocated, lambda: march.camera_samples(
            strands, maxt, self.offset, self.depth, shade=wanted, view=found.collocated,
            shares=tuple(march.share(p.medium.field.softness.opaque) for p in self.scene.in_view)))
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
        points = self.seen.points(samples, i, lambda: self._points(i, part, samples, index, t, kept))
        if self.sums:
            distance = (dr.gather(mi.Float, samples.bundle.base, index) + t) * unit
            distance += self.way if dr.width(self.way) == 1 else dr.gather(mi.Float, self.way, index)
            self.sums.add_field(i, part, points, samples, kept, distance, self.scene.shadow(part, "mapped"))
        if self.effects.lit:
            reflected = self._with_bounces(part, points, self.scene.reflect(part, points, self.stream, view))
            for channel, value in zip(light, reflected, strict=True):
                where = dr.arange(mi.UInt32, dr.width(t)) if kept is None else kept
                dr.scatter_reduce(dr.ReduceOp.Add, channel, value * weight, where, mode=dr.ReduceMode.NoConflicts)

    def _points(self, i: int, part: Part, samples, index, t, kept) -> shade.Points:
        x, along = samples.place(i, index, t)
        lane = dr.arange(mi.UInt32, dr.width(t)) if kept is None else kept
        ordinal = lane - dr.gather(mi.UInt32, samples.first, index)
        number = dr.gather(mi.UInt32, self.number, index)
        points = shade.Points(x, tuple(-c for c in along), part.medium.reflectance(x), number, ordinal)
        points.evaluate()
        return points

    def _with_bounces(self, part: Part, points, light):
        """`light` that `points` reflect of a run, and, in the first, what comes to them by way of others."""
        bounced = self.scene.bounced
        if not bounced or not self.first_run:
            return light
        return [a + b for a, b in zip(light, bounced.reflect(part, points), strict=True)]

    def _walk(self) -> Walk:
        return Walk(self.scene, self.scene.settings.max_depth, self.total, self.stream, self.number)

    def _camera(self, transmittance) -> Paths:
        """The camera rays behind the fields."""
        everyone = dr.arange(mi.UInt32, dr.width(self.ray.o))
        way = dr.zeros(mi.Float, dr.width(everyone)) + self.way
        transmitting = self.scene.surfaces and self.scene.surfaces.transmitting
        return Paths(mi.Ray3f(self.ray), mi.Color3f(transmittance), everyone, mi.Float(-1),
                     self._random(self.number, 0), way if transmitting else None)

    def _bounces(self, transmittance):
        """Adds the light of surfaces that the camera sees, and of paths of more than one bounce."""
        surfaces, walk, camera = self.scene.surfaces, self._walk(), self._camera(transmittance)
        # A camera ray goes on from matter, from the surface behind it, or from both.
        onward = []
        if surfaces:
            onward += self._surface_paths(surfaces, walk, camera, self.effects.lit)
        if self.effects.bounces and self.scene.in_view:
            onward += self._field_paths(walk, camera)
        if not onward or not (self.effects.bounces or (surfaces and surfaces.lights_can_be_hit)):
            return
        whole = join(onward)
        walk.run(whole.take(dr.compress(dr.max(whole.weight) > 0)))

    def _random(self, number, purpose: int):
        """Return random streams for the rays of these numbers, different ones for each purpose."""
        other: Any = dr.opaque(mi.UInt32, purpose)
        stream = mi.sample_tea_32(self.stream, other)[1]
        # One seed with other sequences would make neighbours alike.
        start, sequence = mi.sample_tea_32(stream, number)
        return mi.PCG32(dr.width(number), mi.UInt64(start), mi.UInt64(sequence))  # type: ignore[operator]

    def _surface_paths(self, surfaces: Surfaces, walk: Walk, camera: Paths, lit: bool) -> list[Paths]:
        """Add the light of the surfaces that camera rays meet. Return the paths that scatter there, none unless `lit`.
        Sets `crossing`."""
        met: Any = dr.compress(self.hit.is_valid())
        if not dr.width(met) or not (lit or surfaces.shining or surfaces.transmitting):
            return []
        paths = replace(camera.take(met), rng=self._random(dr.gather(mi.UInt32, self.number, met), 1))
        hit = dr.gather(type(self.hit), self.hit, met)
        si = hit.compute_surface_interaction(mi.Ray3f(paths.ray))
        if surfaces.shining and self.first_run:
            walk.add(paths, si.emitter(self.scene.scene).eval(si))
        if not (lit or surfaces.transmitting):
            return []
        paths, self.crossing = walk.on_surface(paths, si, lit)
        return [paths] if lit else []

    def _field_paths(self, walk: Walk, camera: Paths):
        """Yield paths from one shading point of each camera ray, sampled by the points' weights."""
        samples, unit = self.met
        t, strand, weight = samples.draw(camera.rng.next_float32())
        t = (samples.bundle.base + t) * unit
        camera = replace(camera, weight=mi.Color3f(weight))
        dr.eval(t, strand, camera.weight, camera.rng.state)
        for i, part in enumerate(self.scene.in_view):
            index: Any = dr.compress((weight > 0) & (strand == i))
            if dr.width(index):
                yield walk.in_field(part, camera.take(index), dr.gather(mi.Float, t, index), 2)
