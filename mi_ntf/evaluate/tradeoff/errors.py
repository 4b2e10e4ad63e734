"""Error, split into what is noise and what is bias. Images are float arrays (h, w, 3), linear RGB.

Of K pictures a_k by different seeds and a reference R in two independent halves, relative to P = mean R²:

    noise²  = mean Var_k(a_k) / P                 what more samples take away
    bias²   = mean over pairs k ≠ l of (a_k − R)(a_l − R), less the variance of R / P      what stays
    error²  = noise² + bias²                      of one picture

Products of different seeds hold no noise on average, nor does what is taken off leave any of the reference's.
"""

from dataclasses import dataclass
from math import sqrt

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


def pooled(errors) -> Error:
    """One of several :class:`Error` of the same settings: the bias by the inverse of its squared uncertainties, the
    noise of the last."""
    weights = [1 / max(e.uncertainty, 1e-12) ** 2 for e in errors]
    bias = sqrt(sum(w * e.bias**2 for w, e in zip(weights, errors, strict=True)) / sum(weights))
    return Error(errors[-1].noise, bias, sum(weights) ** -0.5)


def z_test(first, second) -> dict[str, float]:
    """Whether the means of two sets of independent pictures (n, h, w, 3) agree.

    ``difference``: relative, of the means over all pixels, `first` over `second` less 1; ``sigma``: its standard error;
    ``z``, their ratio; ``p``, two-sided, by Welch's t-test, since few pictures know their own spread badly;
    ``pictures``: how many of the first. Raises MiNtfError for fewer than four pictures of either.
    """
    a, b = (np.array([np.mean(p, dtype=np.float64) for p in group]) for group in (first, second))
    if min(len(a), len(b)) < 4:
        raise MiNtfError(f"{len(a)} and {len(b)} pictures; a variance needs at least 4 of each")
    size = float(b.mean())
    if size <= 0:
        raise MiNtfError("the crop is black; no relative difference exists")
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    sigma = max(sqrt(va + vb), 1e-12 * size)
    gap = float(a.mean()) - size
    freedom = (va + vb) ** 2 / max(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-300)
    return {"difference": gap / size, "sigma": sigma / size, "z": gap / sigma,
            "p": two_sided(gap / sigma, float(np.clip(freedom, 1, len(a) + len(b) - 2))), "pictures": len(a)}


def two_sided(t: float, freedom: float) -> float:
    """Chance of a larger |t| by Student's distribution of `freedom` degrees: t = √ν tan θ makes its density a power of
    cos θ."""
    begin = np.arctan(abs(t) / sqrt(freedom))

    def integral(low: float) -> float:
        step = (np.pi / 2 - low) / 4096
        angles = low + (np.arange(4096) + 0.5) * step
        return float((np.cos(angles) ** (freedom - 1)).sum() * step)

    return integral(begin) / integral(0.0)
