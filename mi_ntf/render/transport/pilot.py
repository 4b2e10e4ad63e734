"""A pilot: some camera rays of a picture, rendered before it in several ways, on the same random numbers."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import timing
from ..scene import effects
from . import camera_light
from .composition import Composition

BLOCKS, SIDE, SAMPLES = 256, 2, 2
"""Blocks of pixels that the pilot looks at, pixels along a side of a block, and camera rays through each pixel. The
error of 256 blocks is known to about a tenth. Rays of neighbours march together, as those of pictures do, and two rays
tell noise from bias."""
RAYS = BLOCKS * SIDE**2 * SAMPLES
CONFIDENCE = 0.975
"""Chance that the error of a picture is below the pilot's upper bound."""
RESAMPLINGS = 1000
"""Resamplings of the bootstrap, whose own chance moves its bound by a hundredth."""


@dataclass(frozen=True)
class Look:
    """The pilot rendered in one way.

    radiance  (pixels, samples, 3)
    built     seconds of building that do not grow with the picture
    each      seconds of one sample of every pixel of the picture
    took      seconds of the look itself, building left out; `compiling`: of these, compilation
    """

    composition: Composition
    radiance: np.ndarray
    built: float
    each: float
    took: float
    compiling: float


class Error(NamedTuple):
    """Relative RMSE of a picture: the estimate, and the bound that it is below with the chance ``CONFIDENCE``."""

    estimate: float
    bound: float


class Pilot:
    """Camera rays through blocks of pixels on the film of `sensor`.

    Half of the blocks lie all over the film. The others lie in the boxes that the fields `media` take on the film, as
    many in each box. `weight` (pixels,): share of the picture that each pixel stands for.
    """

    def __init__(self, sensor, media: list, blocks: int = BLOCKS):
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
        at = np.repeat(pixels, SAMPLES, 1) + (rng.random((2, n)) - 0.5) / size[:, None]
        aperture = mi.Point2f(*(mi.Float(v) for v in rng.random((2, n))))
        moment = mi.Float(rng.random(n) * float(sensor.shutter_open_time()) + float(sensor.shutter_open()))
        ray, self._importance = sensor.sample_ray_differential(
            moment, 0.0, mi.Point2f(*(mi.Float(v) for v in at)), aperture)
        self._ray = mi.Ray3f(ray)
        if dr.width(self._ray) < n:  # a sensor whose rays are all the same
            self._ray = dr.gather(mi.Ray3f, self._ray, dr.zeros(mi.UInt32, n))
        self._quadrature = tuple(mi.Float(v) for v in rng.random((2, n)))
        dr.eval(self._ray, self._importance, self._quadrature)

    def look(self, compose: Callable[[], Composition]) -> Look:
        """Render the pilot by the composition that `compose` makes."""
        begin = time.perf_counter()
        composition, made = timing.measure(compose)
        (radiance, seen), seconds = timing.measure(lambda: self._trace(composition))
        # Rays that meet nothing take next to no time.
        rays = self._pixels * float(self.weight @ seen) / max(SAMPLES * int(seen.sum()), 1)
        built = made.building + seconds.building
        return Look(composition, radiance, built, seconds.kernels * rays, time.perf_counter() - begin - built,
                    made.compiling + seconds.compiling)

    def _trace(self, composition: Composition):
        total, seen = mi.Color3f(0), mi.Bool(False)
        for run in range(len(composition.runs)):
            composition.select(run)
            with composition.lights.bare():
                light, opacity = camera_light.trace(composition, self._ray, self._quadrature, dr.opaque(mi.UInt32, 7))
            total += light * self._importance
            seen |= opacity > 0
            dr.eval(total, seen)
        return (np.array(total, np.float64).T.reshape(-1, SAMPLES, 3),
                np.array(seen).reshape(-1, SAMPLES).any(1))

    def error(self, look: Look, truth: Look, samples: float) -> Error:
        """Return the error of a picture of so many samples a pixel against one by `truth`, both on the same random
        numbers; 0 for a black truth.

        The mean product of two different samples' deviations has the bias alone, whatever their noise. The noise of the
        deviations is added, as the picture's samples leave it.
        """
        off = look.radiance - truth.radiance
        variance = off.var(1, ddof=1).mean(1)
        squares = (off.mean(1) ** 2).mean(1) + (1 / samples - 1 / SAMPLES) * variance
        pixels = np.stack([self.weight * squares, self.weight * (truth.radiance.mean(1) ** 2).mean(1)])
        sums = pixels.reshape(2, self._blocks, -1).sum(2)  # neighbours are alike
        estimate = _ratio(*sums.sum(1))
        n = self._blocks
        counts = np.random.default_rng(1).multinomial(n, np.full(n, 1 / n), RESAMPLINGS)
        resampled = [_ratio(*pair) for pair in (counts @ sums.T)]
        return Error(estimate, float(np.quantile(resampled, CONFIDENCE)))

    def samples_for(self, noise: float, truth: Look) -> float:
        """Return the samples a pixel after which a picture has this noise (:func:`.passes.noise`)."""
        one, other = (half.mean(1) for half in np.split(truth.radiance, 2, 1))
        whole = (one + other) / 2
        scale = float(self.weight @ np.sqrt(np.maximum(whole.sum(1), 0)))
        shown = float(self.weight @ np.abs(whole - one).sum(1)) / scale if scale > 0 else 0.0
        return max(SAMPLES * (shown / noise) ** 2 / _pixels_of(self._film.rfilter()), 1.0)

    def noise(self, truth: Look) -> float:
        """Return the relative RMS noise of a picture of one sample a pixel."""
        power = float(self.weight @ (truth.radiance.mean(1) ** 2).mean(1))
        variance = float(self.weight @ truth.radiance.var(1, ddof=1).mean(1))
        return math.sqrt(variance / power / _pixels_of(self._film.rfilter())) if power > 0 else 0.0


def _ratio(square: float, power: float) -> float:
    return math.sqrt(max(square, 0.0) / power) if power > 0 else 0.0


def _places(count: int, boxes: list) -> tuple[np.ndarray, np.ndarray]:
    """Return places (2, `count`) of the unit square and their weights, by the mixture of uniform densities over the
    square and over `boxes` (low, high); near places have near numbers, so that rays of one packet stay together."""
    whole = np.zeros(2), np.ones(2)
    regions = [whole, *boxes]
    shares = [0.5, *(0.5 / len(boxes) for _ in boxes)] if boxes else [1.0]
    ends = np.round(np.cumsum([0, *shares]) * count).astype(int)
    turn = 1.32471795724474602596  # the sequence R2 of Roberts 2018, even in each of the regions
    parts = []
    for (low, high), first, last in zip(regions, ends, ends[1:], strict=False):
        index = np.arange(first, last)
        parts.append(low[:, None] + (np.stack([index / turn, index / turn**2]) % 1) * (high - low)[:, None])
    places = np.concatenate(parts, 1)
    density = np.zeros(count)
    for (low, high), share in zip(regions, shares, strict=True):
        inside = ((places >= low[:, None]) & (places <= high[:, None])).all(0)
        density += share * inside / np.prod(high - low)
    order = np.argsort(_along_curve(places), kind="stable")
    return places[:, order], 1 / (count * density[order])


def _along_curve(places: np.ndarray) -> np.ndarray:
    """Return the numbers of places (2, n) of the unit square along Morton's curve (1966)."""
    x, y = (256 * places).astype(np.int64)
    return sum(((x >> bit & 1) << 2 * bit) + ((y >> bit & 1) << 2 * bit + 1) for bit in range(8))


def _pixels_of(rfilter) -> float:
    """Return the number of pixels whose samples a pixel of the film is as quiet as the mean of."""
    radius = float(rfilter.radius())
    x = np.linspace(-radius, radius, 65)
    f = np.array(rfilter.eval(mi.Float(x)), np.float64).ravel()
    across = 2 * radius * f.mean() ** 2 / max(float((f**2).mean()), 1e-12)
    return max(across, 1.0) ** 2
