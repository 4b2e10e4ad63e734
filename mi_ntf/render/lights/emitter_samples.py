"""Lights sampled at random for each shading point, by Mitsuba's own emitter sampling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer import ops, scatter
from ...infer.lights import LightSample
from ...infer.shade import Points
from ...infer.types import Array, Color3, Float, Mask, UInt32, Vector, Vector3
from ..scene.frame import Frame
from ..scene.recent import Recent, Version
from . import environment

SAMPLES = 2
"""Resampled lights per point of each emitter with an extent, where all discrete lights are summed."""
CANDIDATES = 4
"""Candidates of a resampled light. Each costs a sample, and more of them lower the variance less and less."""
LEAST_TARGET = 0.01
"""Least target of a lit candidate, relative to its irradiance. It bounds the weight of candidates that scatter little.
"""
STRIDE = 3242174889, 2447445414
"""Powers of the inverse plastic number times 2³²: the additive sequence R2, which fills a square evenly."""
BLOCK = 8
"""Neighbouring camera rays, mostly of one pixel, whose points share one run of the sequence, ``BLOCK`` per ray."""
NARROW = 0.25
"""Radius relative to the distance below which an emitter lights a point from about one side. Resampling gains nothing
then."""
SHARP = 1000.0
"""Density of a sampled direction, 1/sr, above which its light is a sun, whose shadow lookups would blur. A disc of half
a degree with a tenth of all samples has 1500, a lamp of 10° with all samples has 42."""
CERTAIN = 0.1
"""Probability above which a light of one place or direction is a sun, unless it is the only light."""
PROBES = 64
"""Largest number of rows and columns of an environment at which its sampling density is looked up."""
_copies: Recent[mi.Emitter | None] = Recent(2)


def sharp(ds: mi.DirectionSample3f, probability: Float = 1.0) -> Mask:
    """Return True where a direction sample is one of a sun; `probability`: that of sampling its emitter."""
    density: Float = ds.pdf * probability
    return dr.select(ds.delta, (density > CERTAIN) & (density < 0.999), density > SHARP)


class Candidate(NamedTuple):
    """Candidate of a resampled light.

    number      among the candidates of the light
    d           scene direction from the point to the light
    irradiance  divided by the density of `d`
    distance    in scene units
    sun         see :func:`sharp`
    """

    number: UInt32
    d: Vector3
    irradiance: Color3
    distance: Float
    sun: Mask


class EmitterSamples:
    """Random lights of any emitters, as a :class:`mi_ntf.infer.lights.LightSource`; unbiased, noisy.

    A light of a wide emitter is selected among a few candidates, with probabilities in proportion to the light that
    each would scatter to the viewer without shadows (Talbot et al. 2005). The light is weighted so that its expected
    value is the sum over all emitters.

    weights    probabilities of the emitters, in any scale
    points     shading points in the field coordinates of `frame`
    seed       opaque unsigned integer
    count      lights per point, each of an emitter selected by weight; 0: ``SAMPLES`` lights of each emitter, or 1 if
               it has no extent
    least      least number of lights, of all emitters together or of each with an extent
    gradients  emitters or points are attached; the selected candidate is then sampled once more
    """

    moving = False

    def __init__(self, emitters: Sequence[mi.Emitter], weights: Sequence[float], frame: Frame, points: Points,
                 seed: UInt32, count: int = 0, least: int = 0, *, gradients: bool = False) -> None:
        self.frame, self.points, self._gradients = frame, points, gradients
        # A single emitter needs no call through a table.
        self._emitters: Array = mi.EmitterPtr(emitters) if len(emitters) > 1 else emitters[0]
        self._choice = mi.DiscreteDistribution(list(weights)) if count and len(emitters) > 1 else None
        candidates = [1 if _narrow(e, frame) else CANDIDATES for e in emitters]
        together = CANDIDATES if len(emitters) > 1 else candidates[0]
        rows = [(0, together)] * (count and max(count, least)) or [
            (i, candidates[i])
            for i, e in enumerate(emitters)
            for _ in range(1 if mi.has_flag(e.flags(), mi.EmitterFlags.DeltaPosition) else max(SAMPLES, least))
        ]
        most = max(n for _, n in rows)
        self._probability: Float = mi.Float(list(weights)) * (1 / max(sum(weights), 1e-30))
        self.count, self.far = len(rows), all(_outside(e, frame) for e in emitters)
        of_emitter = [sum(row[0] == i for row in rows) for i in range(len(emitters))]
        self._emitter, self._candidates, self._fraction = (
            mi.UInt32([i for i, _ in rows]),
            mi.UInt32([n for _, n in rows]),
            mi.Float([1 / of_emitter[i] for i, _ in rows]),
        )
        # Random numbers of a point follow from its ray, not from its place among all points, so that other settings get
        # the same numbers on the same rays.
        block: Array = mi.sample_tea_32(points.ray // BLOCK, seed)
        index = (points.ray & (BLOCK - 1)) * BLOCK + points.ordinal
        start = index * dr.opaque(mi.UInt32, self.count * most)
        self._point: UInt32 = mi.sample_tea_32(points.ray, points.ordinal)[0]
        self._shift = [a + start * b for a, b in zip(block, STRIDE, strict=True)]
        self._seed, self._most, self._single = mi.UInt32(seed), mi.UInt32(most), most == 1
        dr.make_opaque(self._emitter, self._candidates, self._fraction, self._seed, self._most)
        dr.eval(self._point, self._shift)

    def sample(self, index: UInt32, x: Vector, active: Mask) -> LightSample:
        """Return sampled light `index` seen from `x`; a :func:`sharp` one is a sun."""
        it = dr.zeros(mi.Interaction3f, dr.width(x[0]))
        it.p = self.frame.point_to_world(x)
        number, weight = mi.UInt32(0), dr.gather(mi.Float, self._fraction, index, active)
        if not self._single:
            with ops.suspend_grad():
                (number, d, irradiance, distance, sun), weight = self._resample(index, it, active)
        if self._gradients or self._single:
            _, d, irradiance, distance, sun = self._candidate(index, number, it, active)
        irradiance = irradiance * weight
        wi = self.frame.direction_to_field(d)
        return LightSample(wi, tuple(irradiance), distance / self.frame.unit, mi.Bool(sun))

    def _resample(self, index: UInt32, it: mi.Interaction3f, active: Mask) -> tuple[Candidate, Float]:
        """Return the candidate selected for light `index`, and the weight of its irradiance in the estimate."""
        candidates = dr.gather(mi.UInt32, self._candidates, index, active)
        fraction = dr.gather(mi.Float, self._fraction, index, active)
        # Scaled, so that a sum of the largest floats is still finite.
        p, scale = self.points, dr.rcp(3 * mi.Float(candidates))

        def body(k: UInt32, selected: tuple[Array, ...], target: Float, total: Float) -> tuple[Array, ...]:
            new = self._candidate(index, k, it, active)
            value, _ = scatter.evaluate(self.frame.direction_to_field(new.d), p.wo, p.reflectance)
            # Light may be negative.
            scattered = dr.abs(sum(scale * e * v for e, v in zip(new.irradiance, value, strict=True)))
            least = LEAST_TARGET * dr.abs(sum(scale * e for e in new.irradiance))
            new_target = dr.select(scattered > 0, dr.maximum(scattered, least), 0)
            total = total + new_target
            u = mi.sample_tea_float32(self._point ^ self._seed, index * self._most + k)
            replaced = u * total < new_target
            selected = tuple(dr.select(replaced, a, b) for a, b in zip(new, selected, strict=True))
            return k + 1, selected, dr.select(replaced, new_target, target), total

        def more(k: UInt32, selected: tuple[Array, ...], target: Float, total: Float) -> Mask:
            return active & (k < candidates)

        n = dr.width(it.p)
        zero: UInt32 = dr.zeros(mi.UInt32, n)
        none = (mi.UInt32(zero), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Color3f, n), dr.ones(mi.Float, n),
                dr.zeros(mi.Bool, n))
        _, selected, target, total = dr.while_loop(
            state=(zero, none, dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)),
            cond=more,
            body=body,
            label="light candidates",
        )
        return Candidate(*selected), dr.select(target > 0, fraction * total / (target * candidates), 0)

    def _candidate(self, index: UInt32, k: UInt32, it: mi.Interaction3f, active: Mask) -> Candidate:
        """Return candidate `k` of light `index`, a sample of Mitsuba's."""
        n = index * self._most + k
        # Evenly spread over the candidates of a point, each uniform by itself; 24 bits of a float's mantissa.
        u: list[Float] = [mi.Float((shift + n * stride) >> 8) * 2**-24
                          for shift, stride in zip(self._shift, STRIDE, strict=True)]
        emitter: Array = self._emitters
        chosen: UInt32 = mi.UInt32(0)
        weight: Float = 1
        if isinstance(emitter, mi.EmitterPtr):
            chosen = dr.gather(mi.UInt32, self._emitter, index, active)
            if self._choice is not None:
                number: Array = self._choice.sample_reuse_pmf(u[0], active)
                chosen, u[0], pmf = number
                weight = dr.rcp(pmf)
            emitter = dr.gather(mi.EmitterPtr, emitter, chosen, active)
        ds, irradiance = emitter.sample_direction(it, mi.Point2f(*u), active)
        ds.d = dr.normalize(ds.d)  # an environment's has the length of its to_world
        sun = sharp(ds, dr.gather(mi.Float, self._probability, chosen, active))
        irradiance = dr.select(ds.pdf > 0, irradiance * weight, 0)
        return Candidate(k, mi.Vector3f(ds.d), mi.Color3f(irradiance), mi.Float(ds.dist), sun)


def _outside(emitter: mi.Emitter, frame: Frame) -> bool:
    """Return True if an emitter is known to lie outside of the unit sphere of `frame`."""
    if emitter.is_environment():
        return True
    shape = emitter.get_shape()
    if shape is None:
        return False
    box = shape.bbox()
    nearest = np.clip(frame.origin, np.array(box.min), np.array(box.max))
    return bool(np.linalg.norm(nearest - frame.origin) > frame.length)


def _narrow(emitter: mi.Emitter, frame: Frame) -> bool:
    """Return True if an emitter lights each point of the unit sphere of `frame` evenly and from about one side."""
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta):
        return True
    shape = emitter.get_shape()
    if shape is None or mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
        return False
    box = shape.bbox()
    radius, middle = np.linalg.norm(np.array(box.extents())) / 2, np.array(box.center())
    return bool(radius < NARROW * (np.linalg.norm(middle - frame.origin) - frame.length))


def fully_sampled(emitter: mi.Emitter) -> mi.Emitter:
    """Return an emitter of the same light whose own sampling covers all of it.

    An ``envmap`` with `mis_compensation` (Karlík et al. 2019) never samples radiance below its mean, and leaves it to
    BSDF samples. Points of fields have emitter samples alone, so a copy without `mis_compensation` is returned. Any
    other emitter is returned as it is.
    """
    if emitter.class_name() != "EnvironmentMapEmitter":
        return emitter
    copy = Version(emitter).once(_copies, lambda: _uncompensated(emitter) if _is_compensated(emitter) else None)
    return copy or emitter


def _is_compensated(emitter: mi.Emitter) -> bool:
    """Return True if the sampling density of an ``envmap`` is not in proportion to its luminance.

    At the centres of texels it is, to rounding, unless `mis_compensation` has subtracted the mean luminance. The
    density is then 0 wherever the luminance is below the mean, so any threshold between 0 and 1 separates the two.
    """
    height, width = mi.traverse(emitter)["data"].shape[:2]
    row, column = (np.unique(np.linspace(a, n - 1 - a, PROBES).astype(int)) for a, n in ((1, height), (0, width - 2)))
    theta, phi = np.meshgrid(row * np.pi / (height - 1), (column + 0.5) * 2 * np.pi / (width - 2), indexing="ij")
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], -1).reshape(-1, 3)
    towards = local @ environment.placement(emitter, "envmap")[0].T
    luminance = environment.radiance(emitter, towards * environment.scale(emitter)) @ [0.212671, 0.715160, 0.072169]
    ds = dr.zeros(mi.DirectionSample3f, len(towards))
    ds.d = mi.Vector3f(*(towards * environment.scale(emitter)).T.astype(np.float32))
    density = np.array(emitter.pdf_direction(dr.zeros(mi.Interaction3f, len(towards)), ds), np.float64)
    lit = luminance > 1e-3 * luminance.max()
    ratio = density[lit] / luminance[lit]
    return bool(lit.any() and ratio.min() < 0.5 * ratio.max())


def _uncompensated(emitter: mi.Emitter) -> mi.Emitter:
    """Return an ``envmap`` of the same parameters, without `mis_compensation`."""
    copy: mi.Emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))})
    ours, theirs = mi.traverse(copy), mi.traverse(emitter)
    for key in ("data", "scale", "to_world"):
        ours[key] = theirs[key]
    ours.update()
    return copy
