"""More than one bounce: paths through fields and between surfaces, a wavefront a bounce."""

import itertools
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...infer import scatter, shade

ROULETTE_DEPTH = 5
"""Paths may end at random from this depth on, as Mitsuba's path tracers do."""

STEPS = 128
"""Cells of a further flight across a field's sphere, at most, each asked at the ends of its pieces: brightness of
`examples/three_fields.py` differs by 0.02 % from that of 384, in 0.8 of the time; of `globe` by 0.013 %, of `cloud` by
0.005 % (point light, three bounces)."""


@dataclass(frozen=True)
class Paths:
    """Rays on their way: `weight` of the light that they bring to their `pixel`; `pdf` of the BSDF sample that sent
    them, −1 for a specular one, 0 where they come from a field, whose light is summed at its points; random stream.
    `way`: distance from the last scattering point to where `ray` begins, None where no surface can be crossed."""

    ray: Any
    weight: Any
    pixel: Any
    pdf: Any
    rng: Any
    way: Any = None

    def take(self, index) -> "Paths":
        """Return those of the given indices."""
        return replace(self, **{name: dr.gather(type(a), a, index) for name, a in self._values()})

    def put(self, others: "Paths", index) -> None:
        """Write `others` to the given places."""
        for (_, a), (_, b) in zip(self._values(), others._values(), strict=True):
            dr.scatter(a, b, index)

    def _values(self) -> list:
        pairs = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return [(name, value) for name, value in pairs if value is not None]


def join(parts: list[Paths]) -> Paths:
    """Return the paths of all `parts`, one after the other; at least one has some."""
    if len(parts) == 1:
        return parts[0]
    ends = list(itertools.accumulate(dr.width(paths.pixel) for paths in parts))
    whole = next(p for p in parts if dr.width(p.pixel)).take(dr.zeros(mi.UInt32, ends[-1]))
    for paths, end in zip(parts, ends, strict=True):
        count = dr.width(paths.pixel)
        whole.put(paths, dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, end - count))
    return whole


class Walk:
    """`composition`: the scene; `max_depth`: longest path in edges, −1 for any; `total`: three arrays of a float a
    pixel, which light is added to; `number`: of each pixel's camera ray, which random lights follow from."""

    def __init__(self, composition, max_depth: int, total, stream, number):
        self.scene, self.max_depth, self.total, self.stream = composition, max_depth, total, stream
        self.number = number

    def run(self, paths: Paths, depth: int = 2) -> None:
        """Follow `paths`, whose light would arrive over `depth` edges."""
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

    def add(self, paths: Paths, light) -> None:
        """Add `light` times the paths' weights to their pixels."""
        for total, value in zip(self.total, paths.weight * light, strict=True):
            # By default Dr.Jit sums copies for each thread, and the number of pixels would be part of the kernel.
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, paths.pixel, mode=dr.ReduceMode.Direct)

    def _flight(self, paths: Paths, depth: int, last: bool) -> tuple[Paths, Paths | None]:
        """Follow paths to their next vertices, in fields or on surfaces, and add the light there. Return those that
        scatter and, apart, those that cross a surface, which is no vertex; None: no surface lets any cross. `last`:
        only emitters add light, since paths are as long as they may be."""
        surfaces, crossing = self.scene.surfaces, None
        si = surfaces.intersect(paths.ray) if surfaces else None
        if surfaces and surfaces.lights_can_be_hit:
            self.add(paths, surfaces.emission(si, paths.ray, paths.pdf, paths.pdf != 0, paths.way))
        if last and not (surfaces and surfaces.transmitting):
            return paths, None
        n = dr.width(paths.pixel)
        hit, t, which = self._fly(paths, si.t if si else mi.Float(dr.inf))
        onward = paths.take(dr.arange(mi.UInt32, n))
        onward = replace(onward, weight=dr.zeros(mi.Color3f, n))
        for i, part in enumerate(() if last else self.scene.parts):
            index: Any = dr.compress(hit & (which == i))
            if dr.width(index):
                there = self.in_field(part, paths.take(index), dr.gather(mi.Float, t, index), depth)
                onward.put(there, index)
        index = dr.compress(~hit & si.is_valid()) if si is not None else ()
        if dr.width(index):
            there = paths.take(index)
            there, crossing = self.on_surface(there, surfaces.intersect(there.ray), not last)
            onward.put(there, index)
        return onward, crossing

    def _fly(self, paths: Paths, end):
        """Return whether paths scatter in a field before the distance `end`, where, and the number of its part."""
        n = dr.width(paths.pixel)
        hit, t, which = dr.zeros(mi.Bool, n), end, dr.zeros(mi.UInt32, n)
        if self.scene.parts:
            depths = [-dr.log(1 - paths.rng.next_float32()) for _ in self.scene.parts]
            steps = min(STEPS, self.scene.settings.samples)
            hit, t, which = self.scene.fly(paths.ray, t, paths.rng.next_float32(), depths, steps)
            if self.scene.effects.visibility == "none":
                hit = hit & (paths.pdf != 0)  # nothing dims what leaves a field, so nothing scatters it either
        dr.eval(hit, t, which, paths.rng.state)
        return hit, t, which

    def in_field(self, part, paths: Paths, t, depth: int) -> Paths:
        """Paths that meet a point of `part` at the distance `t`; at `depth` 2 its direct light is known already."""
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
        return replace(paths, ray=ray, weight=weight, pdf=zero, way=None if paths.way is None else mi.Float(zero))

    def on_surface(self, paths: Paths, si, lit: bool) -> tuple[Paths, Paths | None]:
        """Add the direct light at the surface points `si`, if `lit`. Return the paths that scatter there, one for each
        of `paths`, and those that cross the surface (None: no surface lets any)."""
        surfaces = self.scene.surfaces
        active = si.is_valid() & (dr.max(paths.weight) > 0)
        if lit:
            self.add(paths, surfaces.direct(si, paths.rng, active))
            # One kernel for each: fused, Dr.Jit 1.5 defines a BSDF's function twice and LLVM refuses it.
            dr.eval(self.total, paths.rng.state)
        ray, weight, pdf, crossed = surfaces.scatter(si, paths.rng, active)
        weight = paths.weight * weight
        scattered = replace(paths, ray=ray, weight=weight, pdf=pdf)
        if not surfaces.transmitting:
            return scattered, None
        dr.eval(scattered.ray, weight, pdf, crossed, paths.rng.state)
        straight = replace(paths, ray=ray, weight=weight, way=paths.way + si.t)
        straight = straight.take(dr.compress(crossed & (dr.max(weight) > 0)))
        return replace(scattered, weight=dr.select(crossed, 0, weight), way=dr.zeros(mi.Float, dr.width(pdf))), straight

    def _roulette(self, paths: Paths, depth: int) -> Paths:
        """The paths that still carry light."""
        weight = dr.max(paths.weight)
        alive = weight > 0
        if depth > ROULETTE_DEPTH:
            chance = dr.detach(dr.minimum(weight, 0.95))  # who survives has no derivative
            alive = alive & (paths.rng.next_float32() < chance)
            paths = replace(paths, weight=paths.weight * dr.select(alive, dr.rcp(chance), 0))
        return paths.take(dr.compress(alive))
