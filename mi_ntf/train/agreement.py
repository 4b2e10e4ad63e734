"""Agreement of photographs with each other, judged by what remains between each of them and the common field."""

import math
from dataclasses import dataclass

import torch

from . import device
from .rays import Photographs
from .scoring import FieldView, decibels, srgb

PIXELS = 1000
"""Pixels of each photograph that are compared, …"""
FEWEST = 50
"""… and the fewest, below which a photograph is not judged."""
KNOWN = 20.0
"""PSNR of the median photograph, dB, above which the field is good enough to judge photographs."""
BEHIND = 5.0
"""Distance below the median, dB, from which a photograph disagrees with the others; 4.5 times the usual spread, too."""
MATTER = 0.9
"""Alpha above which a pixel belongs to the object."""
MOVED = 0.25
"""RMS shift, pixels, of the photographs against the field from which poses count as inexact. The field follows about
half of the true shifts."""


@dataclass(frozen=True)
class Agreement:
    """Differences between the photographs of the training split and the field."""

    psnr: torch.Tensor
    """PSNR (views,) of the object's pixels, dB; NaN where they are too few."""
    shift: torch.Tensor  # Shifts (views, 2) of the photographs against the field, right and down, in pixels

    @property
    def moved(self) -> float:
        """Root mean square of the shifts' lengths; the mean shift counts as the field's."""
        apart = self.shift - self.shift.median(0).values
        return float(apart.square().sum(1).mean().sqrt())

    @property
    def known(self) -> bool:
        """True if the field is good enough to judge photographs."""
        return bool(self.psnr.nanmedian() > KNOWN)

    def outliers(self) -> list[int]:
        """Return the numbers of the photographs that the others contradict."""
        middle = self.psnr.nanmedian()
        spread = (self.psnr - middle).abs().nanmedian()
        numbers: list[int] = ((middle - self.psnr) > torch.clamp(4.5 * spread, min=BEHIND)).nonzero()[:, 0].tolist()
        return numbers


@torch.no_grad()
def survey(field: FieldView, pool: Photographs, gains: torch.Tensor | None, most: float = math.inf) -> Agreement:
    """Compare some pixels of all photographs with the field, about `most` in all; `gains` are (views, 3)."""
    generator, psnr, shift = device.generator(8), [], []
    each = int(max(FEWEST, min(PIXELS, most / pool.views)))
    for number in range(pool.views):
        pixels, *_ = pool.frame(number)
        matter = pixels[pool.pixels(pixels)[:, 3] > MATTER]
        pixels = matter[torch.randperm(len(matter), generator=generator)[:each]]
        if len(pixels) < FEWEST:
            psnr.append(torch.nan)
            shift.append(torch.zeros(2))
            continue
        rays = pool[pixels]
        color = field.render(rays, generator).color
        predicted = srgb(color if gains is None else color * gains[number])
        target = srgb(rays.target[:, :3])
        psnr.append(decibels(float((predicted - target).square().mean())))
        shift.append(_shift(pool, pixels, (target - predicted).mean(1)))
    return Agreement(torch.tensor(psnr), torch.stack(shift))


def _shift(pool: Photographs, pixels: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Return the shift (2,), in pixels, that explains the `error` (n,) at `pixels` (n,) by the photograph's slopes.

    It is a least-squares fit (Lucas and Kanade 1981), repeated without the largest errors.
    """
    def beside(offset: int) -> tuple[torch.Tensor, torch.Tensor]:
        neighbour = pool.pixels((pixels + offset).clamp(0, len(pool) - 1))
        return srgb(neighbour[:, :3]).mean(1), neighbour[:, 3] > MATTER

    (left, a), (right, b), (above, c), (below, d) = (beside(step) for step in (-1, 1, -pool.width, pool.width))
    # Slopes at the outline are the largest, and half of their errors are in pixels that are not compared.
    inside = a & b & c & d
    slope, error = torch.stack([right - left, below - above], 1)[inside] / 2, error[inside]
    used, shift = torch.ones_like(error), torch.zeros(2)
    for _ in range(2 if len(error) >= FEWEST else 0):
        weighted = slope * used[:, None]
        shift = torch.linalg.solve(weighted.T @ slope + 1e-4 * torch.eye(2), weighted.T @ -error)
        rest = (error + slope @ shift).abs()
        used = (rest < 3 * rest.median()).float()
    return shift
