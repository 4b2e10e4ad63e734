"""The march along a ray from the light inwards: the places at which its optical depth passes given levels."""

from collections.abc import Sequence

import drjit as dr

from ..core import spheres
from ..core.depth_profile import LEVELS
from . import ops
from .bundle import density_where, onward, safe_inverse
from .grid import Density
from .network import density_of
from .types import Array, Float, Mask, Place, Vector

BORDER = 1e-3
"""Distance inside the border at which the density there is evaluated, in steps."""


class DepthProfile:
    """A march through `volume` in steps of `step`, an opaque float, field units."""

    def __init__(self, volume: Density, step: Float):
        self.volume, self.step = volume, step

    def __call__(self, o: Vector, d: Vector, levels: Sequence[float] = LEVELS,
                 begin: Float | None = None) -> tuple[list[Float], Float]:
        """Return ``(places, total)`` of the rays through `o` along `d` towards the light.

        Parameters
        ----------
        levels
            Optical depths, ascending; the march ends at the last one.
        begin
            t' of a light inside the sphere, beyond which no matter counts.

        Notes
        -----
        For places and total see :func:`mi_ntf.core.depth_profile.frame`. σ is taken in the middle of each step, linear
        across it with the slope from the step before, or from the border. Constant σ would place the levels too close
        to the light where density sets in. Steps stay on one lattice even where empty space is skipped, so neighbouring
        rays agree.
        """
        return self.with_end(o, d, levels, begin)[:2]

    def with_end(self, o: Vector, d: Vector, levels: Sequence[float],
                 begin: Float | None) -> tuple[list[Float], Float, Float]:
        """Return ``(places, total, last)``; behind the place `last` the march met no more matter."""
        hit, m, h = spheres.chord(ops, o, d)
        near, far = self.volume.extent(m, d, h)
        back = tuple(-c for c in d)
        inverse = safe_inverse(back)
        floats = type(o[0])
        step = self.step

        def cross(s: Float, depth: Float, before: Float, last: Float, place: Place,
                  *places: Float) -> tuple[Array, ...]:
            sigma = density_of(self.volume.log_density(place))
            after = depth + sigma * step
            rate = dr.rcp(dr.maximum(sigma * step, 1e-6))
            bend = dr.clip(0.5 * (sigma - before) * step * rate, -1, 1)
            fractions = [(q - depth) * rate for q in levels]  # of the step, for constant σ
            places = tuple(
                dr.select((g > 0) & (g <= 1), s + step * (g + bend * g * (1 - g)), c)
                for c, g in zip(places, fractions, strict=True)
            )
            return after, sigma, dr.select(sigma > 0, s + step, last), *places

        def skip_step(s: Float, depth: Float, before: Float, last: Float, place: Place,
                      *places: Float) -> tuple[Array, ...]:
            return depth, type(before)(0), last, *places

        def body(s: Float, depth: Float, before: Float, places: tuple[Float, ...], last: Float,
                 active: Mask) -> tuple[Array, ...]:
            place = self.volume.place(tuple(mi + (h - s - 0.5 * step) * di for mi, di in zip(m, d, strict=True)))
            skip = self.volume.clear_distance(place, inverse)
            depth, before, last, *crossed = ops.if_stmt(
                (s, depth, before, last, place, *places), active & (skip <= 0), cross, skip_step, label="cross"
            )
            s = s + onward(skip, step)
            return s, depth, before, tuple(crossed), last, active & (s < stop) & (depth < levels[-1])

        zero = dr.zeros(floats, dr.width(h))
        start, stop = zero + (h - far), h - near
        if begin is not None:
            start = dr.maximum(h - begin, start)
        active = dr.mask_t(floats)(hit & (start < stop))
        # Matter may begin at once at the border of the extent.
        border = tuple(mi + (h - start - BORDER * step) * di for mi, di in zip(m, d, strict=True))
        before = density_where(active, self.volume, self.volume.place(border))
        state = (start, zero, before, tuple(floats(zero) for _ in levels), floats(zero), active)
        _, depth, _, places, last, _ = ops.while_loop(
            state=state,
            cond=lambda s, depth, before, places, last, active: active,
            body=body,
            label="ray profile",
        )
        return [h - c for c in places], depth, h - last
