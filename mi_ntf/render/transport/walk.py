"""Paths of more than one bounce through fields and between surfaces, one wavefront for each bounce."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi

from ...infer import scatter, shade
from ...infer.types import Array, Color3, Float, Mask, Ray, UInt32
from .composition import Composition
from .shadow import Part

STEPS = 128
"""Most cells across a field's sphere for flights after the first bounce, which are smoother than camera rays."""


@dataclass(frozen=True)
class Paths:
    """Rays on their way through the scene.

    weight    of the light that a ray brings to its `pixel`
    pdf       density of the BSDF sample that sent the ray; −1: specular; 0: from a field, whose light is summed at
              its points
    distance  from the last scattering point to the origin of `ray`; None where no surface can be crossed
    """

    ray: Ray
    weight: Color3
    pixel: UInt32
    pdf: Float
    rng: Array
    distance: Float | None = None

    def take(self, index: UInt32) -> Paths:
        """Return the paths of the given indices."""
        return replace(self, **{name: dr.gather(type(a), a, index) for name, a in self._values()})

    def put(self, paths: Paths, index: UInt32) -> None:
        """Write `paths` to the given indices."""
        for (_, a), (_, b) in zip(self._values(), paths._values(), strict=True):
            dr.scatter(a, b, index)

    def _values(self) -> list[tuple[str, Array]]:
        pairs = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return [(name, value) for name, value in pairs if value is not None]


def join(parts: Sequence[Paths]) -> Paths:
    """Return the paths of all `parts`, one after the other. At least one part must not be empty."""
    if len(parts) == 1:
        return parts[0]
    ends = list(itertools.accumulate(dr.width(paths.pixel) for paths in parts))
    joined = next(p for p in parts if dr.width(p.pixel)).take(dr.zeros(mi.UInt32, ends[-1]))
    for paths, end in zip(parts, ends, strict=True):
        count = dr.width(paths.pixel)
        joined.put(paths, dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, end - count))
    return joined


class Walk:
    """Random walk of paths through a scene.

    max_depth  longest path in edges; −1: no limit
    total      light of each pixel so far, three arrays
    number     number of each pixel's camera ray, from which sampled lights follow
    """

    def __init__(self, composition: Composition, max_depth: int, total: list[Float], stream: UInt32,
                 number: UInt32) -> None:
        self.scene, self.max_depth, self.total, self.stream = composition, max_depth, total, stream
        self.number = number

    def run(self, paths: Paths, depth: int = 2) -> None:
        """Follow `paths` to their ends; their next vertices are at `depth` edges from the camera."""
        while dr.width(paths.pixel):
            last = 0 <= self.max_depth <= depth
            depth += 1
            scattered = []
            flying: Paths | None = paths
            while flying and dr.width(flying.pixel):
                onward, flying = self._flight(flying, depth, last)
                scattered.append(onward)
            if last:
                return
            paths = self._roulette(join(scattered), depth)

    def add(self, paths: Paths, light: Color3) -> None:
        """Add `light` times the paths' weights to their pixels."""
        for total, value in zip(self.total, paths.weight * light, strict=True):
            # The default mode sums copies for each thread, whose kernels depend on the number of pixels.
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, paths.pixel, mode=dr.ReduceMode.Direct)

    def _flight(self, paths: Paths, depth: int, last: bool) -> tuple[Paths, Paths | None]:
        """Follow paths to their next vertices, in fields or on surfaces, and add the light there.

        Returns the paths that scatter and those that cross a surface, which is no vertex; None if no path can cross a
        surface. `last`: the paths have their full length, and only emitters add light.
        """
        surfaces = self.scene.surfaces
        crossing: Paths | None = None
        si = surfaces.intersect(paths.ray) if surfaces else None
        if surfaces and surfaces.lights_can_be_hit:
            self.add(paths, surfaces.emission(si, paths.ray, paths.pdf, paths.pdf != 0, paths.distance))
        if last and not (surfaces and surfaces.transmitting):
            return paths, None
        n = dr.width(paths.pixel)
        hit, t, number = self._fly(paths, si.t if si else mi.Float(dr.inf))
        onward = paths.take(dr.arange(mi.UInt32, n))
        onward = replace(onward, weight=dr.zeros(mi.Color3f, n))
        for i, part in enumerate(() if last else self.scene.parts):
            index: UInt32 = dr.compress(hit & (number == i))
            if dr.width(index):
                scattered = self.in_field(part, paths.take(index), dr.gather(mi.Float, t, index), depth)
                onward.put(scattered, index)
        if surfaces and si is not None:
            index = dr.compress(~hit & si.is_valid())
            if dr.width(index):
                incident = paths.take(index)
                scattered, crossing = self.on_surface(incident, surfaces.intersect(incident.ray), not last)
                onward.put(scattered, index)
        return onward, crossing

    def _fly(self, paths: Paths, end: Float) -> tuple[Mask, Float, UInt32]:
        """Return a mask of the paths that scatter in a field before the distance `end`, the distance, and the part."""
        n = dr.width(paths.pixel)
        hit, t, number = dr.zeros(mi.Bool, n), end, dr.zeros(mi.UInt32, n)
        if self.scene.parts:
            depths = [-dr.log(1 - paths.rng.next_float32()) for _ in self.scene.parts]
            hit, t, number = self.scene.free_flight(paths.ray, t, paths.rng.next_float32(), depths, STEPS)
            if self.scene.effects.visibility == "none":
                hit = hit & (paths.pdf != 0)  # light that leaves a field is neither attenuated nor scattered
        dr.eval(hit, t, number, paths.rng.state)
        return hit, t, number

    def in_field(self, part: Part, paths: Paths, t: Float, depth: int) -> Paths:
        """Return `paths` scattered at the distance `t` in `part`; add the direct light there unless `depth` is 2."""
        frame = part.frame
        x = frame.point_to_field(paths.ray.o + t * paths.ray.d)
        number = dr.gather(mi.UInt32, self.number, paths.pixel)
        points = shade.Points(x, tuple(-c for c in frame.direction_to_field(paths.ray.d)), part.medium.reflectance(x),
                              number)
        points.evaluate()
        if depth > 2:
            self.add(paths, mi.Color3f(*self.scene.reflect(part, points, self.stream + dr.opaque(mi.UInt32, depth))))
        u = [paths.rng.next_float32() for _ in range(3)]
        wi = scatter.sample(points.wo, points.reflectance, u[0], (u[1], u[2]))
        value, pdf = scatter.evaluate(wi, points.wo, points.reflectance)
        weight = paths.weight * dr.select(pdf > 1e-8, mi.Color3f(*value) / pdf, 0)
        ray = mi.Ray3f(frame.point_to_world(x), frame.direction_to_world(wi))
        zero = dr.zeros(mi.Float, dr.width(t))
        distance = None if paths.distance is None else mi.Float(zero)
        return replace(paths, ray=ray, weight=weight, pdf=zero, distance=distance)

    def on_surface(self, paths: Paths, si: Array, lit: bool) -> tuple[Paths, Paths | None]:
        """Add the direct light at the surface points `si` if `lit`.

        Returns the paths that scatter there, one for each of `paths`, and those that cross the surface, None if no path
        can cross a surface.
        """
        surfaces = self.scene.surfaces
        assert surfaces
        active = si.is_valid() & (dr.max(paths.weight) > 0)
        if lit:
            self.add(paths, surfaces.direct(si, paths.rng, active))
            # Kept apart from the next kernel: fused, Dr.Jit 1.5 defines a BSDF's function twice, which LLVM refuses.
            dr.eval(self.total, paths.rng.state)
        ray, weight, pdf, crossed = surfaces.scatter(si, paths.rng, active)
        weight = paths.weight * weight
        scattered = replace(paths, ray=ray, weight=weight, pdf=pdf)
        # Kept apart from the next kernel again: LLVM refuses the sample of a single path, fused, and ends the process.
        dr.eval(ray, weight, pdf, crossed, paths.rng.state)
        if not surfaces.transmitting:
            return scattered, None
        straight = replace(paths, ray=ray, weight=weight, distance=paths.distance + si.t)
        straight = straight.take(dr.compress(crossed & (dr.max(weight) > 0)))
        weight = dr.select(crossed, 0, weight)
        return replace(scattered, weight=weight, distance=dr.zeros(mi.Float, dr.width(pdf))), straight

    def _roulette(self, paths: Paths, depth: int) -> Paths:
        """Return the paths that still carry light; from `rr_depth` on, a random choice of them."""
        weight = dr.max(paths.weight)
        alive = weight > 0
        if depth > self.scene.settings.rr_depth:
            chance = dr.detach(dr.minimum(weight, 0.95))  # the choice has no derivative
            alive = alive & (paths.rng.next_float32() < chance)
            paths = replace(paths, weight=paths.weight * dr.select(alive, dr.rcp(chance), 0))
        return paths.take(dr.compress(alive))
