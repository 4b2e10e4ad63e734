"""Camera rays through a composition: radiance and opacity."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ...infer import march, shade
from ...infer.samples import Samples
from ...infer.types import Array, Color3, Float, Ray, UInt32
from ..lights import environment
from ..scene.camera import Quadrature
from .aovs import Sums
from .composition import Composition
from .shadow import Part
from .surfaces import Surfaces
from .walk import Paths, Walk, join


@dataclass
class SampleCache:
    """Samples of camera rays and their field points, for renders in which only the lights differ.

    The caller must discard it when rays, fields, surfaces or the step size change.

    samples  by the options of :func:`mi_ntf.infer.march.camera_samples`: shade, view
    points   by the same options and the number of the field
    chunks   caches of chunks of pixels, by their first source pixel
    """

    samples: dict[tuple[bool, bool], Samples] = field(default_factory=dict)
    points: dict[tuple[bool, bool, int], shade.Points] = field(default_factory=dict)
    chunks: dict[int, SampleCache] = field(default_factory=dict)

    def chunk(self, first: int) -> SampleCache:
        """Return the cache of the rays through source pixels from `first` on."""
        return self.chunks.setdefault(first, SampleCache())


class _FieldSamples(NamedTuple):
    """Samples in the fields along camera rays; `unit`: scene length of the unit of their t."""

    samples: Samples
    unit: Float


def trace(composition: Composition, ray: Ray, quadrature: Quadrature, stream: UInt32, sums: Sums | None = None,
          cache: SampleCache | None = None) -> tuple[Color3, Float]:
    """Return ``(radiance, opacity)`` of camera rays.

    Parameters
    ----------
    quadrature
        Numbers that place the samples along the rays.
    stream
        Opaque seed of all other random numbers.
    sums
        Sums to which further outputs are added.
    cache
        Cache of the samples of these very rays.
    """
    composition.seed_lookups(stream)
    return _CameraLight(composition, ray, quadrature, stream, sums, cache).trace()


class _CameraLight:
    """Light along camera rays.

    distance       from the camera to the rays' origins
    number         number of each ray, from which its random numbers follow; None: its place
    hit            preliminary intersections with surfaces; None without surfaces
    total          sum of the light so far, three arrays
    field_samples  samples in the fields; None without fields in view
    crossing       rays that continue straight on through surfaces; None without any
    first_run      the first run of lights is traced, which has everything else that shines, too
    """

    def __init__(self, composition: Composition, ray: Ray, quadrature: Quadrature, stream: UInt32, sums: Sums | None,
                 cache: SampleCache | None, distance: Float | None = None, number: UInt32 | None = None) -> None:
        self.scene, self.ray, self.stream, self.sums, self.cache = composition, ray, stream, sums, cache
        self.quadrature = quadrature
        self.effects, self.first_run = composition.effects, not composition.run
        self.total: list[Float] = [dr.zeros(mi.Float, dr.width(ray.o)) for _ in range(3)]
        self.hit: Array = None
        self.field_samples: _FieldSamples | None = None
        self.crossing: Paths | None = None
        self.distance = mi.Float(0) if distance is None else distance
        self.number = dr.arange(mi.UInt32, dr.width(ray.o)) if number is None else number

    def trace(self) -> tuple[Color3, Float]:
        """Return ``(radiance, opacity)``."""
        surfaces, ray, effects = self.scene.surfaces, self.ray, self.effects
        if surfaces:
            self.hit = surfaces.first(ray)
            dr.eval(self.hit)
        transmittance = self._fields() if self.scene.in_view else dr.ones(mi.Float, dr.width(ray.o))
        if (surfaces or effects.bounces == "paths") and self.first_run:
            with self.scene.with_all_lights():
                self._bounces(transmittance)
        elif surfaces and surfaces.transmitting:
            self._surface_paths(surfaces, self._walk(), self._camera_paths(transmittance), lit=False)
        opacity = 1 - transmittance
        radiance = mi.Color3f(*self.total)
        missed: Array = True
        if self.hit is not None:
            missed = ~self.hit.is_valid()
            opacity = dr.select(missed, opacity, 1)
        if self.sums:
            self.sums.add_opacity(opacity)
            if self.hit is not None:
                self.sums.add_surface(ray, self.hit, self._transmittance_to_surface(transmittance), self.distance)
        if effects.background and self.first_run:
            behind = environment.background(self.scene.scene.environment(), ray.d)
            radiance += dr.select(missed, transmittance, 0) * behind
            opacity = dr.ones(mi.Float, dr.width(ray.o))
        if self.crossing is not None and dr.width(self.crossing.pixel):
            radiance, opacity = self._behind(self.crossing, radiance, opacity, transmittance)
        return radiance, opacity

    def _transmittance_to_surface(self, transmittance: Float) -> Float:
        """Return the transmittance of the rays that end on surfaces, 0 for rays that cross them."""
        if self.crossing is not None and dr.width(self.crossing.pixel):
            transmittance = mi.Float(transmittance)
            dr.scatter(transmittance, mi.Float(0), self.crossing.pixel)
        return transmittance

    def _behind(self, paths: Paths, radiance: Color3, opacity: Float, transmittance: Float) -> tuple[Color3, Float]:
        """Add the light behind surfaces that rays cross; return ``(radiance, opacity)`` of all rays."""
        pixel = paths.pixel
        quadrature = self.quadrature.take(pixel)
        number = dr.gather(mi.UInt32, self.number, pixel)
        # Evaluated here, so that rays behind any number of surfaces are traced by the same kernels.
        dr.eval(*quadrature, paths.ray, paths.weight, paths.distance, pixel, number, radiance, opacity, transmittance)
        sums = self.sums and self.sums.of_rays(dr.width(pixel))
        one: UInt32 = dr.opaque(mi.UInt32, 1)
        stream = mi.sample_tea_32(self.stream, one)[0]
        dr.make_opaque(stream)
        light, opacity_behind = _CameraLight(self.scene, paths.ray, quadrature, stream, sums, None, paths.distance,
                                             number).trace()
        through = dr.gather(mi.Float, transmittance, pixel)
        if self.sums and sums:
            self.sums.add_behind(sums, through, pixel)
        for channel, value in zip(radiance, light * paths.weight, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, channel, value, pixel, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(opacity, 1 - through * (1 - opacity_behind), pixel)
        return radiance, opacity

    def _fields(self) -> Float:
        """Add the light that fields emit, and scatter once; return the transmittance of the rays."""
        effects, parts = self.effects, self.scene.in_view
        strands, unit = self.scene.strands(self.ray, parts)
        maxt = (dr.minimum(self.ray.maxt, self.hit.t) if self.hit is not None else self.ray.maxt) / unit
        shining = effects.lit or effects.emission
        depths = [p.depth for p in parts]
        attached = any(depths)
        options = shining or attached or bool(self.sums and self.sums.needs_points), effects.collocated
        samples = self.cache.samples.get(options) if self.cache else None
        if samples is None:
            samples = march.camera_samples(
                strands, maxt, *self.quadrature, shade=options[0], view=options[1],
                fractions=tuple(march.sample_fraction(p.medium.field.softness) for p in parts))
            if self.cache:
                self.cache.samples[options] = samples
        if attached and dr.width(samples.t):
            samples = samples.attached(depths)
        self.field_samples = _FieldSamples(samples, unit)
        light = [dr.zeros(mi.Float, dr.width(samples.t)) for _ in range(3)]
        for i, part in enumerate(parts):
            self._field(i, part, options, light)
        if shining and dr.width(samples.t):
            self.total[:] = samples.totals(light, effects.gradients)
        transmittance: Float = samples.transmittance
        return transmittance

    def _field(self, i: int, part: Part, options: tuple[bool, bool], light: list[Float]) -> None:
        """Add the light of samples in the field `part`, strand `i`, to `light`, three arrays by sample."""
        assert self.field_samples
        samples, unit = self.field_samples
        weight = samples.weights[i]
        ray, t, view = samples.ray, samples.t, samples.view
        if not dr.width(ray):
            return
        index: UInt32 = dr.arange(mi.UInt32, dr.width(t))  # of the samples in this field
        several = len(self.scene.in_view) > 1
        if several:
            index = dr.compress(weight > 0)
            ray = dr.gather(mi.UInt32, ray, index)
            t, weight = (dr.gather(mi.Float, a, index) for a in (t, weight))
            view = dr.gather(mi.Float, view, index) if view is not None else None
        if not dr.width(ray):
            return
        key = *options, i
        points = self.cache.points.get(key) if self.cache else None
        if points is None:
            x, along = samples.place(i, ray, t)
            ordinal = index - dr.gather(mi.UInt32, samples.first, ray)
            points = shade.Points(x, tuple(-c for c in along), part.medium.reflectance(x),
                                  dr.gather(mi.UInt32, self.number, ray), ordinal)
            points.evaluate()
            if self.cache:
                self.cache.points[key] = points
        if self.sums:
            distance = (dr.gather(mi.Float, samples.bundle.base, ray) + t) * unit
            distance += self.distance if dr.width(self.distance) == 1 else dr.gather(mi.Float, self.distance, ray)
            self.sums.add_field(i, part, points, samples, index if several else None, distance,
                                self.scene.shadow(part, sampled=False))
        emission = points.reflectance.emission
        if emission is not None:
            if self.first_run:
                if self.effects.lit and part.medium.shadow_catcher:
                    arriving = self.scene.arriving(part, points, self.stream)
                    emission = tuple(a * b for a, b in zip(emission, arriving, strict=True))
                self._add(light, emission, weight, index)
        elif self.effects.lit:
            reflected = self.scene.reflect(part, points, self.stream, view if self.effects.collocated else None)
            if self.scene.bounced and self.first_run:
                bounced = self.scene.bounced.reflect(part, points)
                reflected = [a + b for a, b in zip(reflected, bounced, strict=True)]
            self._add(light, reflected, weight, index)

    @staticmethod
    def _add(light: list[Float], radiance: Iterable[Float], weight: Float, index: UInt32) -> None:
        """Add the radiance of the samples `index` to `light`."""
        for channel, value in zip(light, radiance, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, channel, value * weight, index, mode=dr.ReduceMode.NoConflicts)

    def _walk(self) -> Walk:
        return Walk(self.scene, self.scene.settings.max_depth, self.total, self.stream, self.number)

    def _camera_paths(self, transmittance: Float) -> Paths:
        """Return the camera rays behind the fields."""
        pixel = dr.arange(mi.UInt32, dr.width(self.ray.o))
        distance = dr.zeros(mi.Float, dr.width(pixel)) + self.distance
        transmitting = self.scene.surfaces and self.scene.surfaces.transmitting
        return Paths(mi.Ray3f(self.ray), mi.Color3f(transmittance), pixel, mi.Float(-1),
                     self._random(self.number, 0), distance if transmitting else None)

    def _bounces(self, transmittance: Float) -> None:
        """Add the light of surfaces that the camera sees, and of paths with more than one bounce."""
        surfaces, walk, camera = self.scene.surfaces, self._walk(), self._camera_paths(transmittance)
        # A camera ray continues from matter, from the surface behind it, or from both.
        onward: list[Paths] = []
        if surfaces:
            onward += self._surface_paths(surfaces, walk, camera, self.effects.lit)
        if self.effects.bounces and self.scene.in_view:
            onward += self._field_paths(walk, camera)
        if not onward or not (self.effects.bounces or (surfaces and surfaces.lights_can_be_hit)):
            return
        paths = join(onward)
        walk.run(paths.take(dr.compress(dr.max(paths.weight) > 0)))

    def _random(self, number: UInt32, purpose: int) -> Array:
        """Return random number generators for the rays of these numbers, independent for each purpose."""
        opaque_purpose: UInt32 = dr.opaque(mi.UInt32, purpose)
        stream: UInt32 = mi.sample_tea_32(self.stream, opaque_purpose)[1]
        # A common seed with different sequences would correlate neighbours.
        start, sequence = mi.sample_tea_32(stream, number)
        generator: Array = mi.PCG32
        return generator(dr.width(number), mi.UInt64(start), mi.UInt64(sequence))

    def _surface_paths(self, surfaces: Surfaces, walk: Walk, camera: Paths, lit: bool) -> list[Paths]:
        """Add the light of the surfaces that camera rays hit; set `crossing`.

        Returns the paths that scatter there if `lit`.
        """
        index: UInt32 = dr.compress(self.hit.is_valid())
        shining = surfaces.shining and self.scene.settings.max_depth != 0
        if not dr.width(index) or not (lit or shining or surfaces.transmitting):
            return []
        paths = replace(camera.take(index), rng=self._random(dr.gather(mi.UInt32, self.number, index), 1))
        hit = dr.gather(type(self.hit), self.hit, index)
        si = hit.compute_surface_interaction(mi.Ray3f(paths.ray))
        if shining and self.first_run:
            walk.add(paths, si.emitter(self.scene.scene).eval(si))
        if not (lit or surfaces.transmitting):
            return []
        paths, self.crossing = walk.on_surface(paths, si, lit)
        return [paths] if lit else []

    def _field_paths(self, walk: Walk, camera: Paths) -> Iterator[Paths]:
        """Yield paths from one sample of each camera ray, selected by the weights of the samples."""
        assert self.field_samples
        samples, unit = self.field_samples
        t, strand, weight = samples.draw(camera.rng.next_float32())
        t = (samples.bundle.base + t) * unit
        camera = replace(camera, weight=mi.Color3f(weight))
        dr.eval(t, strand, camera.weight, camera.rng.state)
        for i, part in enumerate(self.scene.in_view):
            index: UInt32 = dr.compress((weight > 0) & (strand == i))
            if dr.width(index):
                yield walk.in_field(part, camera.take(index), dr.gather(mi.Float, t, index), 2)
