"""Exposure and white balance of photographs."""

from __future__ import annotations

import numpy as np

GAIN_MEMORY = 0.8
"""Decay of a photograph's running means, each time that a part of it is compared."""


class Gains:
    """Factors by channel that bring pictures of the field to the exposure and white balance of photographs.

    Photographs determine only the product of gain and albedo, so the geometric mean over the photographs stays that of
    the first comparisons.
    """

    def __init__(self, views: int, fixed: bool) -> None:
        self._fixed = fixed
        self.sums = np.zeros((2, views, 3))  # of pictures times photographs, and of squared pictures
        self.level = np.ones(3)

    def add(self, view: int, products: np.ndarray) -> None:
        """Count sums (2, 3) over a part of the photograph `view`."""
        self.sums[:, view] = GAIN_MEMORY * self.sums[:, view] + products

    def settle(self) -> None:
        """Take the present geometric mean as that of all times."""
        self.level = self._raw().mean(0)

    def _raw(self) -> np.ndarray:
        product, square = self.sums
        ratio: np.ndarray = np.where(square > 0, product / np.maximum(square, 1e-30), 1.0)
        logs: np.ndarray = np.log(ratio.clip(1e-3, 1e3))
        return logs

    def all(self) -> np.ndarray:
        """Return the gains (views, 3)."""
        if self._fixed:
            return np.ones(self.sums.shape[1:])
        raw = self._raw()
        result: np.ndarray = np.exp(raw - raw.mean(0) + self.level)
        return result


def products(one: np.ndarray, other: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return sums (2, 3) of pictures times the photograph, and of one picture times the other."""
    return np.stack([(weight * 0.5 * (one + other) * target).sum((0, 1)), (weight * one * other).sum((0, 1))])
