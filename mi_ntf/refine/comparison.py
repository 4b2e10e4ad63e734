"""Held-back photographs beside pictures of the field."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .gains import products
from .photographs import Camera, Photographs
from .subject import Subject

SHOWN, SHOWN_SIZE, SHOWN_RAYS = 3, 128, 1 << 16
"""Number of photographs, their longer side in pixels, and camera rays of each of two pictures."""


class Comparison(NamedTuple):
    """A photograph beside two independent pictures of the field, linear RGB (h, w, 3), where it shows the object."""

    name: str
    photograph: np.ndarray
    pictures: tuple[np.ndarray, np.ndarray]

    @property
    def picture(self) -> np.ndarray:
        """The mean of both pictures."""
        result: np.ndarray = (self.pictures[0] + self.pictures[1]) / 2
        return result


def compare(subject: Subject, held: Photographs, gains: bool) -> list[Comparison]:
    """Return photographs beside pictures of the field as it is; `gains`: fit a factor for each channel."""
    shrink = max(1, -(-max(held.height, held.width) // SHOWN_SIZE))
    shape = held.height // shrink, held.width // shrink
    camera, result = Camera(shape[1], shape[0]), []
    spp = max(1, SHOWN_RAYS // (shape[0] * shape[1]))
    for view in np.unique(np.linspace(0, held.views - 1, SHOWN).round().astype(int)).tolist():
        held.aim(camera, view, shrink=shrink)
        subject.light(held, view)
        target, weight = held.part(view, (0, 0), shape, shrink)
        one, other = (subject.render(camera.sensor, 2 * view + k, spp).numpy() for k in range(2))
        sums = products(one, other, target, weight)
        seen = weight > 0
        factor = seen * (sums[0] / np.maximum(sums[1], 1e-30) if gains else np.ones(3)).astype(np.float32)
        result.append(Comparison(held.names[view], target * seen, (one * factor, other * factor)))
    return result


def difference(pictures: list[Comparison]) -> float:
    """Return the relative RMSE over all pictures, without their noise."""
    error = sum(float(((c.pictures[0] - c.photograph) * (c.pictures[1] - c.photograph)).sum()) for c in pictures)
    return math.sqrt(max(error, 0) / max(sum(float((c.photograph**2).sum()) for c in pictures), 1e-30))
