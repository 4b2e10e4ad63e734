"""The march that describes a ray: where, seen from the light, its optical depth passes given levels."""

from types import ModuleType

import drjit as dr

from ..core import spheres
from ..core.depth_profile import LEVELS
from . import ops
from .bundle import onward, safe_inverse
from .network import density_of

FOR_NETWORKS = 0.93
"""Steps of the march that networks read, in cells of the camera's march: with 1.1 of them `statue` is 2.6 % off, with
0.93 2.4 %, as with 0.75. No simple fraction: where steps end on the voxels' own borders, rounding decides which are
skipped."""
FOR_MAPS = 0.97
"""The same for maps of one logistic that are fitted to the march; those of two take half of it."""


def of(medium, step: float, dj: ModuleType) -> "DepthProfile":
    """The march through `medium` in steps of `step`, field units."""
    return DepthProfile(medium.source, dr.opaque(dj.Float, step))


class DepthProfile:
    """`volume`: a :class:`mi_ntf.infer.grid.Volume`; `step`: opaque float, field units."""

    def __init__(self, volume, step):
        self.volume, self.step = volume, step

    def __call__(self, o, d, levels=LEVELS, begin=None):
        """``(places, total)`` of the rays through `o` along `d` towards the light, as in
        :func:`mi_ntf.core.depth_profile.frame`.

        From the light inwards: σ in the middle of each step, σ linear across it with the slope from the step before.
        Constant σ would find the places too close to the light where density sets in, and points in a skin too dark.
        Steps stay on one lattice, whatever is skipped: a ray a little beside finds the same.
        Ends at the last of the (ascending) `levels`. `begin`: t' of a light inside the sphere, beyond which no matter
        counts.
        """
        return self.with_end(o, d, levels, begin)[:2]

    def with_end(self, o, d, levels, begin=None):
        """``(places, total, last)``: also the place behind which the march met no more matter."""
        hit, m, h = spheres.chord(ops, o, d)
        back = tuple(-c for c in d)
        inverse = safe_inverse(back)
        floats = type(o[0])
        step = self.step

        def cross(s, depth, before, last, place, *places):
            sigma = density_of(self.volume.log_density(place))
            after = depth + sigma * step
            rate = dr.rcp(dr.maximum(sigma * step, 1e-6))
            bend = dr.clip(0.5 * (sigma - before) * step * rate, -1, 1)
            shares = [(q - depth) * rate for q in levels]  # of the step, for constant σ
            places = tuple(
                dr.select((g > 0) & (g <= 1), s + step * (g + bend * g * (1 - g)), c)
                for c, g in zip(places, shares, strict=True)
            )
            return after, sigma, dr.select(sigma > 0, s + step, last), *places

        def pass_by(s, depth, before, last, place, *places):
            return depth, type(before)(0), last, *places

        def body(s, depth, before, places, last, active):
            place = self.volume.place(tuple(mi + (h - s - 0.5 * step) * di for mi, di in zip(m, d, strict=True)))
            skip = self.volume.clear_distance(place, inverse)
            depth, before, last, *places = dr.if_stmt(
                (s, depth, before, last, place, *places), active & (skip <= 0), cross, pass_by, label="cross"
            )
            s = s + onward(skip, step)
            return s, depth, before, tuple(places), last, active & (s < 2 * h) & (depth < levels[-1])

        zero = dr.zeros(floats, dr.width(h))
        start = zero if begin is None else dr.maximum(h - begin, 0)
        active = dr.mask_t(floats)(hit & (start < 2 * h))
        _, depth, _, places, last, _ = dr.while_loop(
            state=(start, zero, floats(zero), tuple(floats(zero) for _ in levels), floats(zero), active),
            cond=lambda s, depth, before, places, last, active: active,
            body=body,
            label="ray profile",
        )
        return [h - c for c in places], depth, h - last
