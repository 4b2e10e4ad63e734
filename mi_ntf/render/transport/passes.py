"""Passes of a render whose number of samples a limit of noise or time decides."""

import math
import time

import numpy as np

from ..scene.settings import Limits

MOST = 1 << 16
"""Samples a pixel, more than which float32 pictures do not show."""
GROWTH = 4
"""A pass has at most as many times the samples of all before it: what they say of noise and time is not exact."""

SHARE = 0.6
"""Of the time or the samples that are left, what a pass is meant to take: the machine may be slower then, the noise
less. `REST`: of the time, what is no longer worth a pass."""
REST = 0.03


def noise(one: np.ndarray, other: np.ndarray, weights: tuple[float, float]) -> float:
    """Monte Carlo noise of the mean picture I of two independent ones, linear RGB (h, w, 3), of `weights` samples a
    pixel each: |I − A| over √I, A from half of the samples, the scale of Cycles' adaptive sampling (its
    ``noise_threshold``), on which I − A is as far off as I itself. Channels are summed, as there.

    Cycles asks this of each pixel; here both sides are summed over the picture first, or pixels next to black would
    decide. Where the halves are unequal, |I − A| is scaled to what it would be.
    """
    a, b = weights
    whole = (a * one + b * other) / (a + b)
    scale = np.sqrt(np.maximum(whole.sum(-1), 0)).sum()
    return float(np.abs(whole - one).sum() * math.sqrt(a / b) / scale) if scale > 0 else 0.0


class Passes:
    """The samples of each pass: as many as `limits` still ask for and the time allows, by what the passes so far took.

    It is made when the render begins. `count`: samples a pixel so far; `noise`, `seconds`: as measured last; `ended`:
    what was reached, ``samples``, ``noise``, ``time`` or ``timeout``.
    """

    def __init__(self, limits: Limits, clock=None):
        self.limits, self._clock = limits, clock or time.monotonic
        self.count, self.passes = 0, 0
        self.noise = math.nan
        self.seconds = 0.0
        self.ended = "samples"
        self._begin = self._started = self._clock()
        self._each = math.inf  # seconds of one sample a pixel

    def first(self, samples: int, runs: int) -> int:
        """Samples of the first pass, `samples` by the scene: those, unless a limit decides. Several runs of lights are
        made anew for each pass: few passes then. What went before is no pass's."""
        self._started = self._clock()
        return samples if not self.limits.of_samples or runs > 1 else 1

    def done(self, samples: int, noise: float) -> None:
        """A pass of so many has ended; `noise` of all so far, nan where that is not known yet."""
        now = self._clock()
        self._each = (now - self._started) / samples
        self._started, self.seconds = now, now - self._begin
        self.count, self.passes, self.noise = self.count + samples, self.passes + 1, noise

    def gone(self) -> float:
        """Seconds since the render began."""
        return self._clock() - self._begin

    def overtime(self, timeout: float) -> bool:
        """Return True if more than `timeout` seconds have passed; never for one below 0."""
        return 0 < timeout < self.gone()

    def next(self) -> int:
        """Samples of the next pass; 0: a limit is reached."""
        wanted = min(GROWTH * self.count, MOST - self.count)
        if self.limits.noise > 0 and math.isfinite(self.noise):
            if self.noise <= self.limits.noise:
                return self._end("noise")
            needed = self.count * (self.noise / self.limits.noise) ** 2 - self.count
            wanted = min(wanted, max(1, self.count // 8, math.ceil(SHARE * needed)))
        elif self.limits.noise > 0:
            wanted = min(wanted, self.count)  # the other half
        if self.limits.seconds > 0:
            left = self.limits.seconds - self.seconds
            if left < max(self._each, REST * self.limits.seconds):
                return self._end("time")
            wanted = min(wanted, max(1, int(SHARE * left / self._each)))
        return wanted if wanted > 0 else self._end("samples")

    def _end(self, why: str) -> int:
        self.ended = why
        return 0
