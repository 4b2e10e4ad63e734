"""A pilot: some camera rays of a picture, rendered in several ways on the same random numbers."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer.types import Array, Color3, Float, Mask
from .. import timing
from ..scene.camera import Quadrature
from ..scene.media import NRFMedium
from . import camera_light, effects
from .composition import Composition

BLOCKS, SIDE, SAMPLES = 256, 2, 2
"""Blocks of neighbouring pixels, which march together as in pictures; pixels along a side of a block; rays through each
pixel, two of which tell noise from bias. 256 blocks give the error to about a tenth."""
RAYS = BLOCKS * SIDE**2 * SAMPLES
CONFIDENCE = 0.975
"""Probability that the error of a picture is below the pilot's upper bound."""
RESAMPLINGS = 1000
"""Resamplings of the bootstrap, enough for a bound that varies by a hundredth."""


@dataclass(frozen=True)
class Look:
    """The pilot rendered in one way.

    radiance   (pixels, samples, 3)
    built      seconds of building, which do not grow with the picture
    each       seconds of one sample of every pixel of the picture
    took       seconds of the pilot itself without building
    compiling  seconds of compilation, a part of `took`
    """

    composition: Composition
    radiance: np.ndarray
    built: float
    each: float
    took: float
    compiling: float


class Error(NamedTuple):
    """Relative RMSE of a picture: the estimate, and an upper bound with the probability ``CONFIDENCE``."""

    estimate: float
    bound: float


class Pilot:
    """Camera rays through blocks of pixels on the film of `sensor`.

    Half of the blocks are spread over the film. The others are in the boxes of the fields `media` on the film, as many
    in each box. `weight` (pixels,): fraction of the picture that each pixel represents.
    """

    def __init__(self, sensor: mi.Sensor, media: Sequence[NRFMedium], blocks: int = BLOCKS) -> None:
        self._film = sensor.film()
        size = np.array([int(n) for n in self._film.crop_size()])
        self._pixels = int(size.prod())
        rng = np.random.default_rng(0)
        boxes = [box for m in media if (box := effects.on_film(sensor, m.frame)) and np.prod(box[1] - box[0]) > 0]
        places, weight = _places(blocks, boxes)
        self._blocks, self.weight = blocks, np.repeat(weight, SIDE**2) / SIDE**2
        n = blocks * SIDE**2 * SAMPLES
        within = np.indices((SIDE, SIDE)).reshape(2, -1) / size[:, None]
        pixels = np.repeat(places, SIDE**2, 1) + np.tile(within, blocks)
        position = np.repeat(pixels, SAMPLES, 1) + (rng.random((2, n)) - 0.5) / size[:, None]
        aperture = mi.Point2f(*(mi.Float(v) for v in rng.random((2, n))))
        moment: Float = mi.Float(rng.random(n) * float(sensor.shutter_open_time()) + float(sensor.shutter_open()))
        wavelength: Float = 0.0
        ray, self._importance = sensor.sample_ray_differential(
            moment, wavelength, mi.Point2f(*(mi.Float(v) for v in position)), aperture)
        self._ray = mi.Ray3f(ray)
        if dr.width(self._ray) < n:  # a sensor whose rays are all the same
            self._ray = dr.gather(mi.Ray3f, self._ray, dr.zeros(mi.UInt32, n))
        self._quadrature = Quadrature(*(mi.Float(v) for v in rng.random((2, n))))
        dr.eval(self._ray, self._importance, *self._quadrature)

    def look(self, compose: Callable[[], Composition]) -> Look:
        """Render the pilot by the composition that `compose` returns."""
        begin = time.perf_counter()
        composition, composing = timing.measure(compose)
        (radiance, visible), tracing = timing.measure(lambda: self._trace(composition))
        # Rays that hit nothing take almost no time.
        rays = self._pixels * float(self.weight @ visible) / max(SAMPLES * int(visible.sum()), 1)
        built = composing.building + tracing.building
        return Look(composition, radiance, built, tracing.kernels * rays, time.perf_counter() - begin - built,
                    composing.compiling + tracing.compiling)

    def _trace(self, composition: Composition) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance (pixels, samples, 3), and a mask of the pixels that show a field or a surface."""
        total: Color3 = mi.Color3f(0)
        visible: Mask = mi.Bool(False)
        for run in range(len(composition.runs)):
            composition.select(run)
            with composition.lights.bare():
                light, opacity = camera_light.trace(composition, self._ray, self._quadrature, dr.opaque(mi.UInt32, 7))
            total += light * self._importance
            visible |= opacity > 0
            dr.eval(total, visible)
        return (np.array(total, np.float64).T.reshape(-1, SAMPLES, 3),
                np.any(np.array(visible).reshape(-1, SAMPLES), 1))

    def error(self, look: Look, truth: Look, samples: float) -> Error:
        """Return the error of a picture against one by `truth` on the same random numbers; 0 if that is black.

        The mean product of the deviations of two different samples estimates the bias alone. The noise of the
        deviations is added, as `samples` per pixel leave it.
        """
        if look is truth:
            return Error(0.0, 0.0)
        deviation = look.radiance - truth.radiance
        variance = deviation.var(1, ddof=1).mean(1)
        squares = (deviation.mean(1) ** 2).mean(1) + (1 / samples - 1 / SAMPLES) * variance
        pixels = np.stack([self.weight * squares, self.weight * (truth.radiance.mean(1) ** 2).mean(1)])
        sums = pixels.reshape(2, self._blocks, -1).sum(2)  # neighbours are correlated
        estimates = np.column_stack([sums.sum(1), sums @ _resamplings(self._blocks)])
        squares, power = np.maximum(estimates[0], 0), np.where(estimates[1] > 0, estimates[1], np.inf)
        errors = np.sqrt(squares / power)
        return Error(float(errors[0]), float(np.quantile(errors[1:], CONFIDENCE)))

    def samples_for(self, noise: float, truth: Look) -> float:
        """Return the samples per pixel that a picture needs for this noise (:func:`.passes.noise`)."""
        one, other = (half.mean(1) for half in np.split(truth.radiance, 2, 1))
        mean = (one + other) / 2
        scale = float(self.weight @ np.sqrt(np.maximum(mean.sum(1), 0)))
        measured = float(self.weight @ np.abs(mean - one).sum(1)) / scale if scale > 0 else 0.0
        return max(SAMPLES * (measured / noise) ** 2 / _pixels_of(self._film.rfilter()), 1.0)

    def noise(self, truth: Look) -> float:
        """Return the relative RMS noise of a picture with one sample per pixel."""
        power = float(self.weight @ (truth.radiance.mean(1) ** 2).mean(1))
        variance = float(self.weight @ truth.radiance.var(1, ddof=1).mean(1))
        return math.sqrt(variance / power / _pixels_of(self._film.rfilter())) if power > 0 else 0.0


@functools.cache
def _resamplings(blocks: int) -> np.ndarray:
    """Return how often each block occurs in each resampling, (blocks, ``RESAMPLINGS``)."""
    counts: np.ndarray = np.random.default_rng(1).multinomial(blocks, np.full(blocks, 1 / blocks), RESAMPLINGS).T
    return counts


def _places(count: int, boxes: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return places (2, `count`) in the unit square and their weights.

    Their density is the mean of the uniform ones over the square and over `boxes` (low, high). Places close to each
    other have close numbers, so that rays of one packet stay together.
    """
    regions = [(np.zeros(2), np.ones(2)), *boxes]
    fractions = [0.5, *(0.5 / len(boxes) for _ in boxes)] if boxes else [1.0]
    ends = np.round(np.cumsum([0, *fractions]) * count).astype(int)
    turn = 1.32471795724474602596  # the sequence R2 of Roberts 2018, even in each of the regions
    parts = []
    for (low, high), first, last in zip(regions, ends, ends[1:], strict=False):
        index = np.arange(first, last)
        parts.append(low[:, None] + (np.stack([index / turn, index / turn**2]) % 1) * (high - low)[:, None])
    places = np.concatenate(parts, 1)
    density = np.zeros(count)
    for (low, high), fraction in zip(regions, fractions, strict=True):
        inside = ((places >= low[:, None]) & (places <= high[:, None])).all(0)
        density += fraction * inside / np.prod(high - low)
    cell: Array = mi.Point2u(*(256 * places).astype(np.uint32))
    order = np.argsort(np.array(mi.math.morton_encode2(cell)), kind="stable")
    return places[:, order], 1 / (count * density[order])


def _pixels_of(rfilter: mi.ReconstructionFilter) -> float:
    """Return the number of pixels whose samples have the variance of a filtered pixel in their mean."""
    radius = float(rfilter.radius())
    x = np.linspace(-radius, radius, 65)
    offset: Float = mi.Float(x)
    f = np.array(rfilter.eval(offset), np.float64).ravel()
    across = float(2 * radius * f.mean() ** 2 / max((f**2).mean(), 1e-12))
    return max(across, 1.0) ** 2
