"""Lights drawn at random for each shading point, by Mitsuba's own emitter sampling."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer import scatter
from ..scene.frame import Frame

SAMPLES = 2
"""Resampled lights a point for each emitter with an extent, where all discrete lights are summed."""
CANDIDATES = 4
"""Draws that a resampled light is kept from. More draws lower the variance less and less, and each of them costs. The
number was measured (docs/speed.md)."""
LEAST = 0.01
"""Of its irradiance that a candidate which is lit counts for at least: what is kept stands for what is not, and of one
that hardly shows so many times its light would be no number."""
STRIDE = 3242174889, 2447445414
"""Powers of the inverse plastic number, times 2³²: the additive sequence R2 that fills a square most evenly."""
BLOCK = 8
"""Camera rays side by side, mostly of one pixel, whose points share one run of the sequence, ``BLOCK`` a ray."""
NARROW = 0.25
"""Emitters whose radius is less than this times their distance light a point from about one side: resampling gains
nothing (`statue`, `skull`: the variance of 1 to 6 candidates is the same to 0.5 %), and every candidate costs."""

SHARP, CERTAIN = 1000.0, 0.1
"""Density of a drawn direction, 1/sr, from which on its light is a sun, whose shadow lookups would blur: a disc of half
a degree that has a tenth of all draws has 1500, a lamp of 10° that has all of them 42. Of a light of one direction or
place, its chance, unless it is alone: methods are asked about one light as they are."""


def sharp(ds, chance=1.0):
    """Return True where a direction sample of Mitsuba's is of such a light; `chance`: of its emitter to be drawn."""
    density = ds.pdf * chance
    return dr.select(ds.delta, (density > CERTAIN) & (density < 0.999), density > SHARP)


class EmitterSamples:
    """Random lights with the interface of :class:`mi_ntf.infer.lights.LightTable`: any emitter, unbiased, noisy.

    emitters  list of Mitsuba emitters
    weights   their chances of being drawn (any scale)
    points    :class:`mi_ntf.infer.shade.Points` that will ask, in the field coordinates of `frame`
    seed      opaque unsigned integer
    count     lights per point, each from an emitter drawn by weight; 0: of every emitter SAMPLES lights, or 1 where
              it has no extent
    least     at least so many, of all emitters together or of each with an extent
    gradients whether emitters or points are attached: what is kept of the candidates is then drawn once more

    far       whether all emitters lie outside of the field's sphere

    A light of a wide emitter is the one that resampling keeps of a few draws, with chances in proportion to the light
    that each would scatter to the viewer, were nothing in the way (Talbot et al. 2005): of the many that could, the few
    worth a visibility. It is weighted so that the mean over all draws is the sum over all emitters.
    """

    def __init__(self, emitters: list, weights: list[float], frame: Frame, points, seed, count: int = 0,
                 least: int = 0, *, gradients: bool = False):
        self.frame, self.points, self._gradients = frame, points, gradients
        # A single one is asked as itself, without a call through a table.
        self._emitters = mi.EmitterPtr(emitters) if len(emitters) > 1 else emitters[0]
        self._choice = mi.DiscreteDistribution(weights) if count and len(emitters) > 1 else None
        candidates = [1 if _narrow(e, frame) else CANDIDATES for e in emitters]
        together = CANDIDATES if len(emitters) > 1 else candidates[0]
        rows = [(0, together)] * (count and max(count, least)) or [
            (i, candidates[i])
            for i, e in enumerate(emitters)
            for _ in range(1 if mi.has_flag(e.flags(), mi.EmitterFlags.DeltaPosition) else max(SAMPLES, least))
        ]
        most = max(n for _, n in rows)
        self._chance = mi.Float(weights) * (1 / max(sum(weights), 1e-30))
        self.count, self.far = len(rows), all(_outside(e, frame) for e in emitters)
        of_emitter = [sum(row[0] == i for row in rows) for i in range(len(emitters))]
        self._emitter, self._candidates, self._share = (
            mi.UInt32([i for i, _ in rows]),
            mi.UInt32([n for _, n in rows]),
            mi.Float([1 / of_emitter[i] for i, _ in rows]),
        )
        # Numbers of a point follow from its ray, not from its place among all points: other settings that are tried on
        # the same rays get the same.
        block: Any = mi.sample_tea_32(points.ray // BLOCK, seed)
        index = (points.ray & (BLOCK - 1)) * BLOCK + points.ordinal
        before = index * dr.opaque(mi.UInt32, self.count * most)
        self._point = mi.sample_tea_32(points.ray, points.ordinal)[0]
        self._shift = [a + before * b for a, b in zip(block, STRIDE, strict=True)]
        self._seed, self._most, self._single = mi.UInt32(seed), mi.UInt32(most), most == 1
        dr.make_opaque(self._emitter, self._candidates, self._share, self._seed, self._most)
        dr.eval(self._point, self._shift)

    def sample(self, index, x, active):
        """Return what ``LightTable.sample`` does, the irradiance being the estimate's, and 1 where the light is
        :func:`sharp`, else 0."""
        it = dr.zeros(mi.Interaction3f, dr.width(x[0]))
        it.p = self.frame.point_to_world(x)
        kept, weight = mi.UInt32(0), dr.gather(mi.Float, self._share, index, active)
        if not self._single:
            with dr.suspend_grad():
                kept, d, irradiance, distance, sun, weight = self._resample(index, it, active)
        if self._gradients or self._single:
            ds, irradiance, sun = self._draw(index, kept, it, active)
            d, distance = ds.d, ds.dist
        irradiance = irradiance * weight
        return self.frame.direction_to_field(d), tuple(irradiance), distance / self.frame.length, mi.UInt32(sun)

    def _resample(self, index, it, active):
        """The candidate kept for light `index`: its number, direction, irradiance over its density, distance and
        whether it is sharp; and the weight of its irradiance in the estimate."""
        candidates = dr.gather(mi.UInt32, self._candidates, index, active)
        share = dr.gather(mi.Float, self._share, index, active)
        p, fraction = self.points, dr.rcp(3 * mi.Float(candidates))

        def body(k, kept, of_kept, total):
            ds, irradiance, sun = self._draw(index, k, it, active)
            value, _ = scatter.evaluate(self.frame.direction_to_field(ds.d), p.wo, p.reflectance)
            # Light may be negative. Scaled, so that the sum of the brightest that floats hold is still one.
            shows = dr.abs(sum(fraction * e * v for e, v in zip(irradiance, value, strict=True)))
            least = LEAST * dr.abs(sum(fraction * e for e in irradiance))
            target = dr.select(shows > 0, dr.maximum(shows, least), 0)
            total = total + target
            u = mi.sample_tea_float32(self._point ^ self._seed, index * self._most + k)
            keep = u * total < target
            this = k, mi.Vector3f(ds.d), mi.Color3f(irradiance), mi.Float(ds.dist), sun
            kept = tuple(dr.select(keep, new, old) for new, old in zip(this, kept, strict=True))
            return k + 1, kept, dr.select(keep, target, of_kept), total

        n = dr.width(it.p)
        zero: Any = dr.zeros(mi.UInt32, n)
        none = (mi.UInt32(zero), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Color3f, n), dr.ones(mi.Float, n),
                dr.zeros(mi.Bool, n))
        _, kept, of_kept, total = dr.while_loop(
            state=(zero, none, dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)),
            cond=lambda k, kept, of_kept, total: active & (k < candidates),
            body=body,
            label="light candidates",
        )
        return *kept, dr.select(of_kept > 0, share * total / (of_kept * candidates), 0)

    def _draw(self, index, k, it, active):
        """Candidate `k` of light `index`: Mitsuba's sample, its irradiance over its density, whether it is sharp."""
        n = index * self._most + k
        # Evenly spread over a point's candidates, each uniform by itself: 24 bits of a float's mantissa.
        u = [mi.Float((shift + n * stride) >> 8) * 2**-24 for shift, stride in zip(self._shift, STRIDE, strict=True)]
        emitter, weight, chosen = self._emitters, 1, mi.UInt32(0)
        if isinstance(emitter, mi.EmitterPtr):
            chosen = dr.gather(mi.UInt32, self._emitter, index, active)
            if self._choice is not None:
                chosen, u[0], pmf = self._choice.sample_reuse_pmf(u[0], active)
                weight = dr.rcp(pmf)
            emitter = dr.gather(mi.EmitterPtr, emitter, chosen, active)
        ds, irradiance = emitter.sample_direction(it, mi.Point2f(*u), active)
        ds.d = dr.normalize(ds.d)  # an environment's has the length of its to_world
        sun = sharp(ds, dr.gather(mi.Float, self._chance, chosen, active))
        return ds, dr.select(ds.pdf > 0, irradiance * weight, 0), sun


def _outside(emitter, frame: Frame) -> bool:
    """Return True if an emitter is known to lie outside of the unit sphere of `frame`."""
    if emitter.is_environment():
        return True
    shape = emitter.get_shape()
    if shape is None:
        return False
    box = shape.bbox()
    nearest = np.clip(frame.origin, np.array(box.min), np.array(box.max))
    return bool(np.linalg.norm(nearest - frame.origin) > frame.length)


def _narrow(emitter, frame: Frame) -> bool:
    """Return True if an emitter lights all points of the unit sphere of `frame` evenly, each from about one side."""
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta):
        return True
    shape = emitter.get_shape()
    if shape is None or mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
        return False
    box = shape.bbox()
    radius, middle = np.linalg.norm(box.extents()) / 2, np.array(box.center())
    return bool(radius < NARROW * (np.linalg.norm(middle - frame.origin) - frame.length))
