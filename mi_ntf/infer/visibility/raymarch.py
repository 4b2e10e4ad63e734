"""``raymarch``: one march per point and light, the reference (method.md, section 7)."""

from types import ModuleType
from typing import TypeAlias

import drjit as dr

from ...core import spheres
from ...core.ops import dot
from .. import ops, tuning
from ..bundle import density_where, safe_inverse, slope_where
from ..grid import Density
from ..lights import LightTable
from ..types import Array, Float, Mask, UInt32, Vector
from .method import Keep, Medium, Method, Options

MAX_OPTICAL_DEPTH = 12.0
"""Optical depth at which light rays end and count as blocked. A strong lamp inside an opaque lantern must not shine
through at τ = 6e-6."""
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
    still, along, far = dr.detach(x), dr.detach(d), dr.detach(length)
    # Places are t' of the chord, small numbers also where `x` lies far outside.
    hit, m, h = spheres.chord(ops, still, along)
    here = spheres.coordinate(still, along)
    first, last_place = volume.extent(m, along, h)
    begin, end = dr.maximum(first, here), dr.minimum(here + far, last_place)
    shortest, longest, growth = steps
    inverse = safe_inverse(along)

    def at(t: Float) -> tuple[Float, ...]:
        return tuple(mi + t * di for mi, di in zip(m, along, strict=True))

    def body(t: Float, sums: tuple[Float, ...], active: Mask) -> tuple[Array, ...]:
        step = dr.minimum(dr.clip(growth * (t - here), shortest, longest), end - t)
        node = t + tuning.NODE * step
        q = at(node)
        place = volume.place(q)
        skip = volume.clear_distance(place, inverse)
        empty = skip > 0
        new: tuple[Float, ...]
        if attached:
            sigma, *slope = slope_where(active & ~empty, volume.density, q)
            new = (sigma, *slope, *((node - here) * s for s in slope))
        else:
            new = (density_where(active & ~empty, volume, place),)
        sums = tuple(a + b * step for a, b in zip(sums, new, strict=True))
        t = dr.select(empty, dr.maximum(node + skip + 1e-4, t + step), t + step)
        return t, sums, active & (t < end - 1e-5) & (sums[0] < MAX_OPTICAL_DEPTH)

    zero = dr.zeros(type(begin), dr.width(begin))
    start = (begin, (zero,) * (7 if attached else 1), active & hit & (end > begin))
    depth, *slopes = ops.while_loop(state=start, cond=lambda t, sums, active: active, body=body, label="light march")[1]
    if not attached:
        return depth
    last = density_where(active & hit & (end > begin) & (end < last_place), volume, volume.place(at(end)))
    return ops.replace_grad(depth, dot(slopes[:3], x) + dot(slopes[3:], d) + last * length)


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
