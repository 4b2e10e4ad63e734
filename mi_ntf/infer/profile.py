"""The march that describes a ray: where, seen from the light, its optical depth passes given levels."""

import drjit as dr

from ..core import spheres
from ..core.depth_profile import LEVELS
from . import ops
from .march import clear_distance, safe_inverse


class DepthProfile:
    """`density`: callable, σ at a point; `grid`: whose empty space is skipped; `step`: opaque float, field units."""

    def __init__(self, density, grid, step):
        self.density, self.grid, self.step = density, grid, step

    def __call__(self, o, d, levels=LEVELS, begin=None):
        """``(places, total)`` of the rays through `o` along `d` towards the light, as in
        :func:`mi_ntf.core.depth_profile.frame`.

        From the light inwards: σ in the middle of each step, depth linear across it. Ends at the last of the
        (ascending) `levels`. `begin`: t' of a light inside the sphere, beyond which no matter counts.
        """
        return self.with_end(o, d, levels, begin)[:2]

    def with_end(self, o, d, levels, begin=None):
        """``(places, total, last)``: also the place behind which the march met no more matter."""
        hit, m, h = spheres.chord(ops, o, d)
        back = tuple(-c for c in d)
        inverse = safe_inverse(back)
        floats = type(o[0])
        step = self.step

        def body(s, depth, places, last, active):
            p = tuple(mi + (h - s - 0.5 * step) * di for mi, di in zip(m, d, strict=True))
            skip = clear_distance(self.grid, p, inverse)
            empty = skip > 0
            sigma = dr.select(active & ~empty, self.density(p), 0)
            after = depth + sigma * step
            rate = dr.rcp(dr.maximum(sigma, 1e-6))
            places = tuple(
                dr.select((depth < q) & (after >= q), s + (q - depth) * rate, c)
                for c, q in zip(places, levels, strict=True)
            )
            last = dr.select(sigma > 0, s + step, last)
            s = s + dr.select(empty, skip + 1e-4, step)
            return s, after, places, last, active & (s < 2 * h) & (after < levels[-1])

        zero = dr.zeros(floats, dr.width(h))
        start = zero if begin is None else dr.maximum(h - begin, 0)
        active = dr.mask_t(floats)(hit & (start < 2 * h))
        _, depth, places, last, _ = dr.while_loop(
            state=(start, zero, tuple(floats(zero) for _ in levels), floats(zero), active),
            cond=lambda s, depth, places, last, active: active,
            body=body,
            label="ray profile",
        )
        return [h - c for c in places], depth, h - last
