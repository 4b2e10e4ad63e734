"""``raymarch``: one march per point and light, the reference."""

from collections.abc import Callable
from types import ModuleType
from typing import TypeAlias

import drjit as dr

from ...core import spheres
from ...core.ops import dot
from .. import ops, tuning
from ..bundle import density_where, safe_inverse, slope_where
from ..grid import Density
from ..lights import LightTable
from ..types import Array, Float, Mask, Place, UInt32, Vector
from .method import Keep, Medium, Method, Options

MAX_OPTICAL_DEPTH = 12.0
"""Optical depth at which light rays end and count as blocked. A strong lamp inside an opaque lantern must not shine
through at τ = 6e-6."""
State: TypeAlias = tuple[Array, ...]
Steps: TypeAlias = tuple[Float, Float, Float]
"""Shortest and longest step, field units, and growth: the step at distance t is growth · t between the two bounds."""


class RayMarch:
    """A march through `volume` from the point to the light.

    Steps begin at the shading point, which lies at a random depth of its camera ray's cell: that is the jitter.
    `gradient_steps`: steps of rays that carry gradients (default: the same).
    """

    def __init__(self, volume: Density, steps: Steps, gradient_steps: Steps | None = None):
        self.volume, self.steps, self.gradient_steps = volume, steps, gradient_steps or steps

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return exp(−∫σ) from `x` to the light, 0 where the march ended before it."""
        steps = self.gradient_steps if dr.grad_enabled(x, wi, distance) else self.steps
        depth = optical_depth(self.volume, x, wi, distance, steps, active)
        return dr.select(depth < MAX_OPTICAL_DEPTH, dr.exp(-depth), 0)


def default_steps(step: float, gradients: bool = False) -> tuple[float, float, float]:
    """Return the steps for a camera march with cells of length `step`, field units.

    They are finest beside the point, which lies in the skin that makes the depth. For cells below 2/384 all of them
    shrink with `step`, so the march converges. `gradients`: for derivatives, which see the slopes of a skin.
    """
    longest = tuning.GRADIENT_STEP if gradients else max(step, min(3 * step, tuning.LONGEST_STEP))
    return tuning.FIRST_STEP * step, longest, min(tuning.STEP_GROWTH, tuning.GROWTH_PER_CELL * step)


def optical_depth(volume: Density, x: Vector, d: Vector, length: Float, steps: Steps, active: Mask) -> Float:
    """Return ∫ σ along x + t d for t in [0, length], clipped to the extent of `volume`; it stops at MAX_OPTICAL_DEPTH.

    `x` may lie outside the sphere. Derivatives by `x`, `d` and `length` are those of the integral. The march sums the
    slopes of σ on its way, detached, and the sums are attached after it, since Dr.Jit loses derivatives by variables
    from outside a loop within a branch or loop.
    """
    attached = dr.grad_enabled(x, d, length)
    ray = _Ray(volume, dr.detach(x), dr.detach(d), dr.detach(length))

    def add(sums: State, node: Float, q: Vector, place: Place, step: Float, matter: Mask) -> State:
        new: State
        if attached:
            sigma, *slope = slope_where(matter, volume.density, q)
            new = (sigma, *slope, *((node - ray.here) * s for s in slope))
        else:
            new = (density_where(matter, volume, place),)
        return tuple(a + b * step for a, b in zip(sums, new, strict=True))

    zero = dr.zeros(type(ray.begin), dr.width(ray.begin))
    depth, *slopes = ray.march((zero,) * (7 if attached else 1), add, steps, active)
    if not attached:
        return depth
    last = density_where(active & ray.crosses & (ray.end < ray.last), volume, volume.place(ray.at(ray.end)))
    return ops.replace_grad(depth, dot(slopes[:3], x) + dot(slopes[3:], d) + last * length)


def drawn_depth(volume: Density, x: Vector, d: Vector, length: Float, steps: Steps, active: Mask
                ) -> tuple[Float, Float]:
    """Return :func:`optical_depth`, detached, and a t on the ray that is drawn in proportion to σ.

    The random numbers follow from the bits of `x` and `d`.
    """
    ray = _Ray(volume, x, d, length)
    uint = dr.uint32_array_t(type(ray.begin))
    seed = uint(0)
    for c in (*x, *d):
        seed = (seed ^ dr.reinterpret_array(uint, type(ray.begin)(c))) * 0x9E3779B1
        seed = seed ^ (seed >> 15)

    def add(sums: State, node: Float, q: Vector, place: Place, step: Float, matter: Mask) -> State:
        depth, t, random = sums
        new = density_where(matter, volume, place) * step
        depth, random = depth + new, random * 1664525 + 1013904223
        uniform = type(depth)(random >> 8) * 2**-24
        return depth, dr.select(uniform * depth < new, node - ray.here, t), random

    zero = dr.zeros(type(ray.begin), dr.width(ray.begin))
    depth, t, _ = ray.march((zero, zero, seed + dr.zeros(uint, dr.width(zero))), add, steps, active)
    return depth, t


class _Ray:
    """A ray of a light march. Places are t' of the chord, small numbers also where `x` lies far outside."""

    def __init__(self, volume: Density, x: Vector, d: Vector, length: Float) -> None:
        self._volume, self._d = volume, d
        self._hit, self._m, h = spheres.chord(ops, x, d)
        self.here = spheres.coordinate(x, d)
        first, self.last = volume.extent(self._m, d, h)
        self.begin, self.end = dr.maximum(first, self.here), dr.minimum(self.here + length, self.last)
        self.crosses = self._hit & (self.end > self.begin)

    def at(self, t: Float) -> Vector:
        """Return the points at `t`."""
        return tuple(mi + t * di for mi, di in zip(self._m, self._d, strict=True))

    def march(self, sums: State, add: Callable[..., State], steps: Steps, active: Mask) -> State:
        """Return the `sums` after all steps, the first of which is the optical depth."""
        shortest, longest, growth = steps
        inverse, volume, here, end = safe_inverse(self._d), self._volume, self.here, self.end

        def body(t: Float, sums: State, active: Mask) -> State:
            step = dr.minimum(dr.clip(growth * (t - here), shortest, longest), end - t)
            node = t + tuning.NODE * step
            q = self.at(node)
            place = volume.place(q)
            skip = volume.clear_distance(place, inverse)
            empty = skip > 0
            sums = add(sums, node, q, place, step, active & ~empty)
            t = dr.select(empty, dr.maximum(node + skip + 1e-4, t + step), t + step)
            return t, sums, active & (t < end - 1e-5) & (sums[0] < MAX_OPTICAL_DEPTH)

        start = (self.begin, sums, active & self.crosses)
        result: State = ops.while_loop(
            state=start, cond=lambda t, sums, active: active, body=body, label="light march")[1]
        return result


def build(medium: Medium, table: LightTable | None, options: Options, dj: ModuleType, keep: Keep) -> RayMarch:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    shortest, longest, growth = (dr.opaque(dj.Float, s) for s in default_steps(options.step))
    fine = tuple(dr.opaque(dj.Float, s) for s in default_steps(options.step, gradients=True))
    return RayMarch(medium.source, (shortest, longest, growth), fine)


METHOD = Method(
    name="raymarch",
    summary="one march through the field per point and light: the reference",
    build=build,
    derivatives=True,
    automatic=True,
)
