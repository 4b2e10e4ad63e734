"""Passes of a render whose number of samples a limit of noise or time decides."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from ..scene.settings import Limits

MOST = 1 << 16
"""Most samples per pixel, which float32 pictures can represent."""
GROWTH = 4
"""Most samples of a pass relative to all before it, whose noise and time are only estimates."""
PASS_FRACTION = 0.6
"""Fraction of the remaining time or samples that a pass should take, since the estimates may be too low."""
REST = 0.03
"""Fraction of the time that is too short for another pass."""


def noise(one: np.ndarray, other: np.ndarray, weights: tuple[float, float]) -> float:
    """Return the Monte Carlo noise of the mean I of two independent pictures, linear RGB (h, w, 3).

    The noise is |I − A| over √I, channels summed, where A has half of the samples: the error of I − A is that of I.
    Cycles computes it for each pixel (its ``noise_threshold``). Here both sides are summed over the picture, or pixels
    close to black would dominate. `weights`: samples per pixel of both pictures; |I − A| is scaled if they differ.
    """
    a, b = weights
    mean = (a * one + b * other) / (a + b)
    scale = np.sqrt(np.maximum(mean.sum(-1), 0)).sum()
    return float(np.abs(mean - one).sum() * math.sqrt(a / b) / scale) if scale > 0 else 0.0


class Passes:
    """Numbers of samples of each pass, as many as `limits` need and the time allows. It is made as the render begins.

    count    samples per pixel so far
    passes   passes so far
    noise    last measurement, nan before the second pass
    seconds  time at the end of the last pass
    ended    limit that was reached: ``samples``, ``noise``, ``time`` or ``timeout``
    """

    def __init__(self, limits: Limits, clock: Callable[[], float] | None = None) -> None:
        self.limits, self._clock = limits, clock or time.monotonic
        self.count, self.passes = 0, 0
        self.noise = math.nan
        self.seconds = 0.0
        self.ended = "samples"
        self._begin = self._started = self._clock()
        self._each = math.inf  # seconds of one sample per pixel

    def first(self, samples: int, runs: int) -> int:
        """Return the samples of the first pass: `samples`, the scene's own, unless a limit decides.

        The maps of several runs of lights are built anew for each pass, so there are few passes then. The time before
        this call belongs to no pass.
        """
        self._started = self._clock()
        return samples if not self.limits.of_samples or runs > 1 else 1

    def done(self, samples: int, noise: float) -> None:
        """Count a pass of so many samples per pixel; `noise`: of all samples so far, or nan."""
        now = self._clock()
        self._each = (now - self._started) / samples
        self._started, self.seconds = now, now - self._begin
        self.count, self.passes, self.noise = self.count + samples, self.passes + 1, noise

    def elapsed(self) -> float:
        """Return the seconds since the render began."""
        return self._clock() - self._begin

    def overtime(self, timeout: float) -> bool:
        """Return True if more than `timeout` seconds have passed; never for one below 0."""
        return 0 < timeout < self.elapsed()

    def next(self) -> int:
        """Return the samples of the next pass; 0: a limit is reached."""
        samples = min(GROWTH * self.count, MOST - self.count)
        if self.limits.noise > 0 and math.isfinite(self.noise):
            if self.noise <= self.limits.noise:
                return self._end("noise")
            needed = self.count * (self.noise / self.limits.noise) ** 2 - self.count
            samples = min(samples, max(1, self.count // 8, math.ceil(PASS_FRACTION * needed)))
        elif self.limits.noise > 0:
            samples = min(samples, self.count)  # the other half
        if self.limits.seconds > 0:
            remaining = self.limits.seconds - self.seconds
            if remaining < max(self._each, REST * self.limits.seconds):
                return self._end("time")
            samples = min(samples, max(1, int(PASS_FRACTION * remaining / self._each)))
        return samples if samples > 0 else self._end("samples")

    def _end(self, limit: str) -> int:
        self.ended = limit
        return 0
