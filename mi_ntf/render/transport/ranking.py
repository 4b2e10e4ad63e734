"""Which groups of probes tell most of a picture, and how much each then stands for."""

import numpy as np

from ...infer.march import GOLDEN

FAINT = 0.3
"""Of what is seen of fields, in mean squares of light, that all have a chance by: it is the light of a few lights
alone, and further bounces are not in it."""


class Ranking:
    """The order in which groups of probes are looked at.

    weight  (groups,): share of the picture that each has
    seen    (groups,): whether it sees anything
    light   (groups,): mean square of what it sees, without shadows, which could only dim it
    small   (groups,): whether it is there for a small field: all that see one are looked at
    count   about how many are looked at first; of those that see something, at least `least`

    `share`: of the picture that sees something. As large a one of the groups does, chosen by their light, as errors are
    large where there is light: chosen evenly, `globe` needs twice as many for as sure a mean square, `knot` four times.
    """

    def __init__(self, weight: np.ndarray, seen: np.ndarray, light: np.ndarray, small: np.ndarray, count: int,
                 least: int):
        self.share, self.seen, self._small = float(weight @ seen), seen, int((small & seen).sum())
        self._count = max(count * self.share, min(count, least)), count * (1 - self.share)
        mean = float((weight * seen) @ light) / max(self.share, 1e-9)
        self._seen = _Priority(np.where(small & seen, np.inf, seen * weight * (light + FAINT * (mean or 1.0))))
        self._other = _Priority(~seen * weight)

    def first(self, times: float) -> tuple[np.ndarray, np.ndarray]:
        """So many times the groups that are looked at first: ``(index, chance)``, their chances to be among them. Those
        of fewer times are among those of more."""
        seen = self._seen.first(self._small + round(times * self._count[0]))
        other = self._other.first(round(times * self._count[1]))
        index, chance = (np.concatenate(pair) for pair in zip(seen, other, strict=True))
        order = np.argsort(index)  # those side by side are seen faster together
        return index[order], chance[order]


class _Priority:
    """Priority sampling (Duffield, Lund and Thorup 2007) of things of these sizes: those with the least u/size are
    chosen, and each stands for itself over its chance to be among them."""

    def __init__(self, size: np.ndarray):
        there = np.flatnonzero(size > 0)
        value = ((np.arange(len(there)) + 0.5) * GOLDEN) % 1 / size[there]
        order = np.argsort(value)
        self._index, self._value, self._size = there[order], value[order], size[there][order]

    def first(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """``(index, chance)`` of as many, where so many are there."""
        limit = self._value[count] if count < len(self._value) else np.inf
        return self._index[:count], np.minimum(self._size[:count] * limit, 1)
