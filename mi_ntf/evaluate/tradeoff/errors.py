"""Error, split into what is noise and what is bias. Images are float arrays (h, w, 3), linear RGB.

Of K pictures a_k by different seeds and a reference R in two independent halves, relative to P = mean R²:

    noise²  = mean Var_k(a_k) / P                 what more samples take away
    bias²   = mean over pairs k ≠ l of (a_k − R)(a_l − R), less the variance of R / P      what stays
    error²  = noise² + bias²                      of one picture

Products of different seeds hold no noise on average, nor does what is taken off leave any of the reference's.
"""

from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np

from ...core.errors import MiNtfError


@dataclass(frozen=True)
class Error:
    """Relative errors (1: as large as the picture). `noise`: of one picture; `bias`: estimated, 0 where the squared
    estimate is negative; `uncertainty`: standard error of bias², so that a bias below √`uncertainty` cannot be told
    from none."""

    noise: float
    bias: float
    uncertainty: float

    @property
    def total(self) -> float:
        """Of one picture."""
        return sqrt(self.noise**2 + self.bias**2)

    @property
    def known(self) -> bool:
        """Whether the bias stands out: two standard errors above 0."""
        return self.bias**2 > 2 * self.uncertainty

    @property
    def most(self) -> float:
        """The bias that two standard errors allow."""
        return sqrt(self.bias**2 + 2 * self.uncertainty)


def split(pictures, reference: np.ndarray, variance: float = 0.0) -> Error:
    """The :class:`Error` of `pictures` (two or more, of different seeds). `variance`: mean squared noise of
    `reference`, 0 for one without. Raises MiNtfError for a black reference and for a single picture."""
    a = np.stack([np.asarray(p, np.float64) for p in pictures])
    r = np.asarray(reference, np.float64)
    if len(a) < 2:
        raise MiNtfError("one picture cannot tell noise from bias; render two seeds")
    power = float(np.mean(r * r)) - variance
    if power <= 0:
        raise MiNtfError("the reference is black everywhere, no relative error exists; was it rendered with a light?")
    noise = float(np.mean(a.var(0, ddof=1)))
    d = a - r
    pairs = (d.sum(0) ** 2 - (d * d).sum(0)) / (len(a) * (len(a) - 1))
    bias = (float(pairs.mean()) - variance) / power
    return Error(sqrt(noise / power), sqrt(max(bias, 0.0)), _uncertainty(pairs) / power)


def _uncertainty(values: np.ndarray) -> float:
    """Standard error of the mean of `values` (h, w, colours), taken for independent from pixel to pixel; where the
    bias itself differs between them a little too large."""
    each = values.mean(-1)
    return float(each.std() / sqrt(each.size))


def pooled(errors) -> float:
    """One bias of several :class:`Error` of the same settings, by the inverse of their squared uncertainties."""
    weights = [1 / max(e.uncertainty, 1e-12) ** 2 for e in errors]
    return sqrt(sum(w * e.bias**2 for w, e in zip(weights, errors, strict=True)) / sum(weights))


def z_test(first, second) -> dict[str, float]:
    """Whether the means of two sets of independent pictures (n, h, w, 3) agree.

    ``difference``: relative, of the means over all pixels, `first` over `second` less 1; ``sigma``: its standard error;
    ``z``; ``p``, two-sided, of the normal distribution; ``far_blocks``: share of 4² blocks that differ by more than
    three of their own standard errors (0.3 % by chance). Raises MiNtfError for fewer than four pictures of either.
    """
    a, b = (np.stack([np.asarray(p, np.float64) for p in group]) for group in (first, second))
    if min(len(a), len(b)) < 4:
        raise MiNtfError(f"{len(a)} and {len(b)} pictures; a variance needs at least 4 of each")
    means = [g.mean((1, 2, 3)) for g in (a, b)]
    size = float(means[1].mean())
    if size <= 0:
        raise MiNtfError("the crop is black; no relative difference exists")
    gap, sigma = _gap(*means)
    z = float(gap / max(sigma, 1e-12 * size))
    blocks = [_blocks(g) for g in (a, b)]
    each, spread = _gap(*blocks)
    far = np.abs(each) > 3 * np.maximum(spread, 1e-6 * size)
    return {"difference": float(gap) / size, "sigma": float(sigma) / size, "z": z, "p": erfc(abs(z) / sqrt(2)),
            "far_blocks": float(far.mean()), "pictures": len(a)}


def _gap(a: np.ndarray, b: np.ndarray):
    """Difference of the means over the first axis, and its standard error."""
    return a.mean(0) - b.mean(0), np.sqrt(a.var(0, ddof=1) / len(a) + b.var(0, ddof=1) / len(b))


def _blocks(pictures: np.ndarray, size: int = 4) -> np.ndarray:
    """Means over size² pixels and colours, (n, blocks); of smaller pictures the whole."""
    n, h, w, c = pictures.shape
    size = min(size, h, w)
    cut = pictures[:, : h // size * size, : w // size * size]
    return cut.reshape(n, h // size, size, w // size, size, c).mean((2, 4, 5)).reshape(n, -1)

