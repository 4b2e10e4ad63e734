"""Error of a mean of pictures, split into noise and bias. Pictures are float arrays (h, w, 3), linear RGB.

Let a_k be pictures of s_k samples a pixel by independent seeds, and m their mean weighted by s_k. Let R be a reference
of variance V, and P = mean R² − V its power. Relative to P:

    error² = mean (m − R)² − V                                    of the mean
    bias²  = mean of (a_k − R)(a_l − R) over pairs k ≠ l − V      the part that remains with more samples
    noise² = error² − bias²                                       the part that more samples remove

The pairs are weighted by s_k s_l. Each estimate is unbiased. Its standard error is that of a mean over pixels, which
are assumed to be independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from ...core.errors import MiNtfError


@dataclass(frozen=True)
class Estimate:
    """Estimate of a squared relative error, which may be negative by chance, and its standard error."""

    square: float
    deviation: float

    @property
    def value(self) -> float:
        """Relative error; 0 where the estimate of its square is negative."""
        return sqrt(max(self.square, 0.0))

    @property
    def uncertainty(self) -> float:
        """Distance from the value to the relative error whose square is one standard error larger."""
        return sqrt(max(self.square, 0.0) + self.deviation) - self.value


@dataclass(frozen=True)
class Truth:
    """Reference picture (h, w, 3), its mean squared noise (0 where that is not known), and a description."""

    image: np.ndarray
    variance: float = 0.0
    about: str = ""

    @property
    def power(self) -> float:
        """Mean square of the picture without its noise; raises MiNtfError for a black picture."""
        power = float(np.mean(np.square(self.image, dtype=np.float64))) - self.variance
        if power <= 0:
            raise MiNtfError("the reference is black, so that no relative error exists; does light reach the object?")
        return power

    @property
    def noise(self) -> float:
        """Noise relative to the picture."""
        return sqrt(self.variance / self.power)


class Mean:
    """Running mean of independent pictures, and its error against a reference."""

    def __init__(self, truth: Truth):
        self._truth, self.pictures, self.samples, self._weights = truth, 0, 0, 0.0
        self._sum, self._squares = np.zeros(truth.image.shape), np.zeros(truth.image.shape)

    def add(self, picture: np.ndarray, samples: int) -> None:
        """Add a picture of so many samples a pixel."""
        difference = samples * (np.asarray(picture, np.float64) - self._truth.image)
        self._sum += difference
        self._squares += difference**2
        self._weights += float(samples) ** 2
        self.pictures, self.samples = self.pictures + 1, self.samples + samples

    @property
    def image(self) -> np.ndarray:
        """Mean of the pictures (h, w, 3)."""
        return (self._truth.image + self._sum / self.samples).astype(np.float32)

    def error(self) -> Estimate:
        """Return the error of the mean."""
        return self._estimate((self._sum / self.samples) ** 2, self._truth.variance)

    def split(self) -> tuple[Estimate, Estimate]:
        """Return noise and bias of the mean. Raises MiNtfError for a single picture, which does not separate them."""
        if self.pictures < 2:
            raise MiNtfError("one picture cannot tell noise from bias; render two seeds")
        pairs = (self._sum**2 - self._squares) / (self.samples**2 - self._weights)
        noise = self._estimate((self._sum / self.samples) ** 2 - pairs, 0.0)
        return noise, self._estimate(pairs, self._truth.variance)

    def shift(self) -> tuple[float, float]:
        """Return the difference of the means over all pixels, relative to the reference, and its standard error."""
        pixels, size = (self._sum / self.samples).mean(-1), float(self._truth.image.mean())
        return float(pixels.mean()) / size, float(pixels.std()) / sqrt(pixels.size) / size

    def _estimate(self, values: np.ndarray, variance: float) -> Estimate:
        pixels, power = values.mean(-1), self._truth.power
        return Estimate((float(pixels.mean()) - variance) / power, float(pixels.std()) / sqrt(pixels.size) / power)


def crossing(seconds: Sequence[float], values: Sequence[float], limit: float) -> float | None:
    """Return the seconds after which the errors `values` fall to `limit`, or None where no point is below it.

    Between two points the curve is straight on log axes. An error below half of the limit counts as half of it, since
    an error may be measured as 0, which has no logarithm.
    """
    for i, value in enumerate(values):
        if value <= limit:
            if i == 0:
                return seconds[0]
            above, below = np.log(values[i - 1]), np.log(max(value, limit / 2))
            weight = (above - np.log(limit)) / (above - below)
            return float(seconds[i - 1] * (seconds[i] / seconds[i - 1]) ** weight)
    return None


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (seconds, error) of the Pareto front, in the order of seconds."""
    best, indices = np.inf, []
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < best:
            best = points[i][1]
            indices.append(i)
    return indices
