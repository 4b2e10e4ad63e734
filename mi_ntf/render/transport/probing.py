"""Some pixels of a picture, rendered beforehand: what they show, how noisy a sample is, and what a picture takes."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cost import measurement
from ..scene import effects
from . import camera_light
from .composition import Composition
from .ranking import Ranking

SHARE = 0.04
"""Of the pixels, those rendered beforehand, at most `MOST` and at least `LEAST`; `SAMPLES` of each."""
MOST, LEAST, SAMPLES = 512, 256, 2
GROUP = 4
"""Pixels side by side that are rendered together, as pictures are: rays of scattered ones that march in one packet wait
for each other, which made probes look four times as dear."""
SCATTERED = 1.6
"""Times as long as samples of a picture those of probes take, whose packets find nothing in the processor's cache: 1.2
to 1.9 where there are many lights, 1.8 to 2.8 by one."""
CAUTION = 0.5
"""Standard errors that are added to a mean square. A few pixels at thin parts have much of it, so it spreads widely:
whole ones refused what keeps to a limit by a quarter (`globe` by an atlas)."""
MIN_OPACITY = 1e-3
"""Less, and nothing of a field is seen."""
SMALL, WITHIN = 0.01, 96
"""A field whose bounds take less than this share of the picture gets as many pixels of its own."""


@dataclass(frozen=True)
class Look:
    """`radiance` (pixels, samples, 3) of the probes, and whether anything is `seen` (pixels,) there; seconds,
    compilation left out: `built` of what does not grow with the picture, `each` of one sample for every pixel of it."""

    composition: Composition
    radiance: np.ndarray
    seen: np.ndarray
    built: float
    each: float

    def and_more(self, other: "Look", share: float) -> "Look":
        """This and the `other` of further probes, which are `share` of the samples of both."""
        return replace(self, radiance=np.concatenate([self.radiance, other.radiance]),
                       seen=np.concatenate([self.seen, other.seen]), each=self.each + share * (other.each - self.each))


class Off(NamedTuple):
    """What a truth errs `by` (pixels, samples, 3) at the `probes` that the march has seen, the first of all; `march`: a
    look by it."""

    probes: "Probes"
    by: np.ndarray
    march: Look


def probed(pixels: int) -> float:
    """The share of so many pixels that is rendered beforehand."""
    return min(max(SHARE * pixels, LEAST), MOST, pixels) / pixels


class Probes:
    """Camera rays through pixels here and there; through those of fields that are small in the picture, all the more.

    weight  (probes,): share of the picture that each stands for
    chance  (groups,): that of each group of `GROUP` probes side by side to be one
    pixels  how many, where so many are there
    """

    _ranking: Ranking
    _times: float

    def __init__(self, sensor, media: list, pixels: int):
        width, height = (int(n) for n in sensor.film().crop_size())
        self._pixels = width * height
        rng = np.random.default_rng(0)
        groups = max(1, round(min(pixels, self._pixels) / GROUP))
        self._evenly = groups  # the others are those of small fields
        places, self.weight = _places(rng, groups, _small(sensor, media), 1 / width)
        self.count, self._like_picture = len(self.weight), 1.0
        self._whole, self._index = self, np.arange(0)
        self.chance = np.zeros(self.count // GROUP)
        self._sharpness = _pixels_of(sensor.film().rfilter())
        place = np.repeat(places, SAMPLES, 1)
        n = place.shape[1]
        place += (rng.random((2, n)) - 0.5) / np.array([[width], [height]])
        aperture = mi.Point2f(*(mi.Float(v) for v in rng.random((2, n))))
        moment = mi.Float(rng.random(n) * float(sensor.shutter_open_time()) + float(sensor.shutter_open()))
        at = mi.Point2f(*(mi.Float(v) for v in place))
        ray, weight = sensor.sample_ray_differential(moment, 0.0, at, aperture)
        self._ray, self._weight = mi.Ray3f(ray), weight
        if dr.width(self._ray) < n:  # a sensor whose rays are all the same
            self._ray = dr.gather(mi.Ray3f, self._ray, dr.zeros(mi.UInt32, n))
        self._quadrature = tuple(mi.Float(v) for v in rng.random((2, n)))
        dr.eval(self._ray, self._weight, self._quadrature)

    def some(self, shown: Look, pixels: int) -> "Probes":
        """About so many of them, those that tell most by what is `shown` of all, without shadows."""
        light = (shown.radiance**2).mean((1, 2)).reshape(-1, GROUP).mean(1)
        seen = np.any(shown.seen.reshape(-1, GROUP), axis=1)
        small = np.arange(len(seen)) >= self._evenly
        weight = self.weight.reshape(-1, GROUP).sum(1)
        ranking = Ranking(weight, seen, light, small, pixels // GROUP, LEAST // GROUP)
        return self._of(ranking, 1, *ranking.first(1))

    def first(self, share: float) -> "Probes":
        """Those of them that tell most, about a `share`."""
        times = share * self._times
        return self._whole._of(self._ranking, times, *self._ranking.first(times))

    def more(self, factor: float = 2) -> tuple["Probes", "Probes"]:
        """Of what these are some of: others, so that all are about `factor` times as many, and all, these first."""
        times = factor * self._times
        index, chance = self._ranking.first(times)
        chances = np.zeros(self._whole.count // GROUP)
        chances[index] = chance
        others = np.setdiff1d(index, self._index)
        both = np.concatenate([self._index, others])
        new, all_ = (self._whole._of(self._ranking, times, groups, chances[groups]) for groups in (others, both))
        return new, all_

    def after(self, first: "Probes") -> "Probes":
        """Those of them that come after the `first`."""
        n = len(first._index)
        return self._whole._of(self._ranking, self._times, self._index[n:], self.chance[n:])

    def _of(self, ranking: Ranking, times: float, index: np.ndarray, chance: np.ndarray) -> "Probes":
        """Those of these groups, which had these chances to be among the first so many `times`."""
        part = copy.copy(self)
        part._whole, part._ranking, part._times, part._index = self, ranking, times, index
        part.chance, part.count = chance, len(index) * GROUP
        hits = float(ranking.seen[index].sum()) / max(len(index), 1)
        part._like_picture = ranking.share / max(hits, 1e-9) or 1.0
        part.weight = (self.weight.reshape(-1, GROUP)[index] / chance[:, None]).ravel()
        rays = mi.UInt32((index[:, None] * GROUP * SAMPLES + np.arange(GROUP * SAMPLES)).ravel())
        part._ray = dr.gather(mi.Ray3f, self._ray, rays)
        part._weight = self._weight if dr.width(self._weight) == 1 else dr.gather(mi.Color3f, self._weight, rays)
        part._quadrature = tuple(dr.gather(mi.Float, v, rays) for v in self._quadrature)
        dr.eval(part._ray, part._weight, part._quadrature)
        return part

    @property
    def samples(self) -> float:
        """Samples for every pixel that take as long as the probes. Rays that meet nothing take next to no time."""
        return SCATTERED * self.count * SAMPLES / (self._pixels * self._like_picture)

    def look(self, compose: Callable[[], Composition]) -> Look:
        """What `compose` makes, seen through the probes."""
        (composition, radiance, seen), stages = measurement.watch(lambda: self._trace(compose()))
        built = sum(stages.get(name, 0.0) for name in measurement.BUILT)
        return Look(composition, radiance, seen, built, (sum(stages.values()) - built) / self.samples)

    def _trace(self, composition: Composition):
        total, seen = mi.Color3f(0), mi.Bool(False)
        for run in range(len(composition.runs)):
            composition.select(run)
            with composition.lights.bare():
                light, opacity = camera_light.trace(composition, self._ray, self._quadrature, dr.opaque(mi.UInt32, 7))
            total += light * self._weight
            seen |= opacity > MIN_OPACITY
            dr.eval(total, seen)
        shape = self.count, SAMPLES
        return composition, np.array(total).T.reshape(*shape, 3), np.array(seen).reshape(shape).any(1)

    def error(self, found: Look, truth: Look, spp: float, caution: float = CAUTION, off: Off | None = None) -> float:
        """Relative RMSE of a picture of `spp` samples, with `caution` standard errors for so few pixels; 0 for a black
        truth. Both are seen along the same rays. Two halves of the samples share a bias, not their noise, which their
        product leaves out: more samples make that smaller, and where lights are drawn it is not a method's own. `off`:
        what the truth errs by itself, as far as the first probes tell."""
        share = 0.0 if truth.composition.lights.sampled else SAMPLES / spp
        off_by = found.radiance - truth.radiance
        mean, variance = self._sum(_squares(off_by, share))
        if off is not None:
            few = off_by[:off.probes.count]
            more, spread = off.probes._sum(_squares(few + off.by, share) - _squares(few, share))
            mean, variance = mean + more, variance + spread
        power = float(self.weight @ (truth.radiance.mean(1) ** 2).mean(1))
        return math.sqrt(max(mean + caution * math.sqrt(variance), 0.0) / power) if power > 0 else 0.0

    def _sum(self, squares: np.ndarray) -> tuple[float, float]:
        """Of the picture, of what each probe has, (probes,), and its variance: neighbours are alike."""
        groups = (self.weight * squares).reshape(-1, GROUP).sum(1)
        return float(groups.sum()), float((1 - self.chance) @ (groups - groups.mean()) ** 2)

    def noise(self, look: Look) -> float:
        """Relative RMS error of a picture of one sample a pixel, whose filter takes the mean of several."""
        power = float(self.weight @ (look.radiance.mean(1) ** 2).mean(1))
        variance = float(self.weight @ look.radiance.var(1, ddof=1).mean(1))
        return float(np.sqrt(variance / power / self._sharpness)) if power > 0 else 0.0


def _squares(off: np.ndarray, share: float) -> np.ndarray:
    """(probes,) mean squares of (probes, samples, 3): what all samples have in common, and a `share` of what not."""
    half = SAMPLES // 2
    both, one, other = off.mean(1), off[:, :half].mean(1), off[:, half:].mean(1)
    return (one * other + share * (both * both - one * other)).mean(1)


def _pixels_of(rfilter) -> float:
    """Pixels whose samples a pixel of the film is made of, counted as a mean of as many would be as noisy."""
    radius = float(rfilter.radius())
    x = np.linspace(-radius, radius, 65)
    f = np.array(rfilter.eval(mi.Float(x)), np.float64).ravel()
    across = 2 * radius * f.mean() ** 2 / max(float((f**2).mean()), 1e-12)
    return max(across, 1.0) ** 2


def _places(rng, count: int, boxes: list, across: float) -> tuple[np.ndarray, np.ndarray]:
    """``(places, weights)``: (2, n) of the unit square, of `GROUP` pixels, `across` wide, side by side: `count` groups
    all over it, and `WITHIN` pixels in each of `boxes`, corners (low, high). What is all over it (by the sequence R2 of
    Roberts 2018) stands for what is in no box."""
    # Evenly, or what few pixels tell would be how many of them meet the object.
    index, turn = np.arange(1, count + 1), 1.32471795724474602596
    first = np.stack([index / turn, index / turn**2]) % 1
    # Rays of one packet wait for each other, and scattered ones wait longest.
    everywhere = _side_by_side(first[:, np.argsort(_along_curve(first))], across)
    places, weights = [everywhere], [np.full(count * GROUP, 1 / (count * GROUP))]
    for low, high in boxes:
        inside = ((places[0] >= low[:, None]) & (places[0] <= high[:, None])).all(0)
        weights[0] = np.where(inside, 0.0, weights[0])
        within = low[:, None] + rng.random((2, WITHIN // GROUP)) * (high - low)[:, None]
        # A group that leaves its box on one side comes back on the other.
        places.append(_side_by_side(within, across, low[0], high[0]))
        weights.append(np.full(WITHIN, np.prod(high - low) / WITHIN))
    return np.concatenate(places, 1), np.concatenate(weights)


def _side_by_side(first: np.ndarray, across: float, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """(2, n · GROUP) places of groups that begin at `first` (2, n), between `low` and `high`, periodic, in u."""
    u = first[0][:, None] + across * np.arange(GROUP)
    return np.stack([low + (u - low).ravel() % (high - low), np.repeat(first[1] % 1, GROUP)])


def _along_curve(places: np.ndarray) -> np.ndarray:
    """Numbers of (2, n) places of the unit square along Morton's curve (1966): near ones have near numbers."""
    x, y = (256 * places).astype(np.int64)
    return sum(((x >> bit & 1) << 2 * bit) + ((y >> bit & 1) << 2 * bit + 1) for bit in range(8))


def _small(sensor, media: list) -> list:
    """Corners, in the unit square, of the boxes that hold those of `media` that are small in the picture."""
    boxes = [effects.on_film(sensor, m.frame) for m in media] if len(media) > 1 else []
    return [b for b in boxes if b is not None and 0 < np.prod(b[1] - b[0]) < SMALL]
