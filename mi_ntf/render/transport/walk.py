"""More than one bounce: paths through fields and between surfaces, a wavefront a bounce."""

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
    them, −1 for a specular one, 0 where they come from a field, whose light is summed at its points; random stream."""

    ray: Any
    weight: Any
    pixel: Any
    pdf: Any
    rng: Any

    def take(self, index) -> "Paths":
        """Those of the given indices."""
        return Paths(*(dr.gather(type(a), a, index) for a in self._values()))

    def put(self, others: "Paths", index) -> None:
        """Write `others` to the given places."""
        for a, b in zip(self._values(), others._values(), strict=True):
            dr.scatter(a, b, index)

    def _values(self) -> list:
        return [getattr(self, f.name) for f in fields(self)]


class Walk:
    """`composition`: the scene; `max_depth`: longest path in edges, −1 for any; `total`: three arrays of a float a
    pixel, which light is added to."""

    def __init__(self, composition, max_depth: int, total, stream):
        self.scene, self.max_depth, self.total, self.stream = composition, max_depth, total, stream

    def run(self, paths: Paths, depth: int = 2) -> None:
        """Follow `paths`, whose light would arrive over `depth` edges."""
        while dr.width(paths.pixel):
            surfaces = self.scene.surfaces
            si = surfaces.intersect(paths.ray) if surfaces else None
            if surfaces and surfaces.lights_can_be_hit:
                self.add(paths, surfaces.emission(si, paths.ray, paths.pdf, paths.pdf != 0))
            if 0 <= self.max_depth <= depth:
                return
            depth += 1
            paths = self._roulette(self._bounce(paths, si, depth), depth)

    def add(self, paths: Paths, light) -> None:
        """Add `light` times the paths' weights to their pixels."""
        for total, value in zip(self.total, paths.weight * light, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, paths.pixel)

    def _bounce(self, paths: Paths, si, depth: int) -> Paths:
        """The next vertices, in fields or on surfaces: their direct light, and the paths on from there."""
        n = dr.width(paths.pixel)
        hit, t, which = dr.zeros(mi.Bool, n), si.t if si else mi.Float(dr.inf), dr.zeros(mi.UInt32, n)
        if self.scene.parts:
            depths = [-dr.log(1 - paths.rng.next_float32()) for _ in self.scene.parts]
            steps = min(STEPS, self.scene.settings.samples)
            hit, t, which = self.scene.fly(paths.ray, t, paths.rng.next_float32(), depths, steps)
            if self.scene.effects.visibility == "none":
                hit = hit & (paths.pdf != 0)  # nothing dims what leaves a field, so nothing scatters it either
        dr.eval(hit, t, which, paths.rng.state)
        onward = paths.take(dr.arange(mi.UInt32, n))
        onward = replace(onward, weight=dr.zeros(mi.Color3f, n))
        for i, part in enumerate(self.scene.parts):
            index: Any = dr.compress(hit & (which == i))
            if dr.width(index):
                there = self.in_field(part, paths.take(index), dr.gather(mi.Float, t, index), depth)
                onward.put(there, index)
        if si is not None:
            index = dr.compress(~hit & si.is_valid())
            if dr.width(index):
                there = paths.take(index)
                onward.put(self.on_surface(there, self.scene.surfaces.intersect(there.ray)), index)
        return onward

    def in_field(self, part, paths: Paths, t, depth: int) -> Paths:
        """Paths that meet a point of `part` at the distance `t`; at `depth` 2 its direct light is known already."""
        frame = part.frame
        x = frame.point_to_field(paths.ray.o + t * paths.ray.d)
        points = shade.Points(x, tuple(-c for c in frame.direction_to_field(paths.ray.d)), part.medium.reflectance(x))
        points.evaluate()
        if depth > 2:
            self.add(paths, mi.Color3f(*self.scene.reflect(part, points, self.stream + dr.opaque(mi.UInt32, depth))))
        u = [paths.rng.next_float32() for _ in range(3)]
        wi = scatter.sample(points.wo, points.reflectance, u[0], (u[1], u[2]))
        value, pdf = scatter.evaluate(wi, points.wo, points.reflectance)
        weight = paths.weight * dr.select(pdf > 1e-8, mi.Color3f(*value) / pdf, 0)
        ray = mi.Ray3f(frame.point_to_world(x), frame.direction_to_world(wi))
        return replace(paths, ray=ray, weight=weight, pdf=dr.zeros(mi.Float, dr.width(t)))

    def on_surface(self, paths: Paths, si) -> Paths:
        """Paths that meet the surface point `si`."""
        surfaces = self.scene.surfaces
        active = si.is_valid() & (dr.max(paths.weight) > 0)
        self.add(paths, surfaces.direct(si, paths.rng, active))
        # One kernel for each: fused, Dr.Jit 1.5 defines a BSDF's function twice and LLVM refuses it.
        dr.eval(self.total, paths.rng.state)
        ray, weight, pdf = surfaces.scatter(si, paths.rng, active)
        return replace(paths, ray=ray, weight=paths.weight * weight, pdf=pdf)

    def _roulette(self, paths: Paths, depth: int) -> Paths:
        """The paths that still carry light."""
        weight = dr.max(paths.weight)
        alive = weight > 0
        if depth > ROULETTE_DEPTH:
            chance = dr.detach(dr.minimum(weight, 0.95))  # who survives has no derivative
            alive = alive & (paths.rng.next_float32() < chance)
            paths = replace(paths, weight=paths.weight * dr.select(alive, dr.rcp(chance), 0))
        return paths.take(dr.compress(alive))
