"""Agreement of photographs with each other, judged by what remains between each of them and the common field."""

import math
from dataclasses import dataclass

import torch

from . import device
from .rays import Photographs
from .scoring import FieldView, decibels, srgb

PIXELS = 1000
"""Largest number of pixels of a photograph that are compared."""
FEWEST = 50
"""Number of compared pixels below which a photograph is not judged."""
KNOWN = 20.0
"""PSNR of the median photograph, dB, above which the field is good enough to judge photographs."""
BEHIND = 5.0
"""Distance below the median, dB, from which a photograph disagrees with the others; 4.5 times the usual spread, too."""
MATTER = 0.9
"""Alpha above which a pixel belongs to the object."""
MOVED = 0.25
"""Shift, pixels, of the photographs against the field from which poses count as inexact. The field follows about half
of the true shifts."""


@dataclass(frozen=True)
class Agreement:
    """Differences between the photographs of the training split and the field."""

    psnr: torch.Tensor
    """PSNR (views,) of the object's pixels, dB; NaN where they are too few."""
    shift: torch.Tensor  # Shifts (views, 2) of the photographs against the field, right and down, in pixels
    halves: torch.Tensor
    """Shifts (views, 2, 2) of the left and the right half of the object in each photograph."""

    @property
    def moved(self) -> float:
        """Root mean square length of the shifts that the halves of the photographs agree on.

        A wrong pose moves both halves alike. Errors of the field, in which a shift may also be seen, are different
        ones in each half, and vanish in the mean product. The mean shift of all photographs counts as the field's.
        """
        apart = self.halves - self.halves.median(0).values
        return float((apart[:, 0] * apart[:, 1]).sum(1).mean().clamp(min=0).sqrt())

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
def survey(field: FieldView, pool: Photographs, gains: torch.Tensor | None, each: int = PIXELS) -> Agreement:
    """Compare `each` pixels of all photographs with the field, FEWEST at least; `gains` are (views, 3)."""
    generator, picked, each = device.generator(8), [], max(FEWEST, each)
    for number in range(pool.views):
        pixels, *_ = pool.frame(number)
        matter = pixels[pool.pixels(pixels)[:, 3] > MATTER]
        picked.append(matter[torch.randperm(len(matter), generator=generator)[:each]])
    rays = pool[torch.cat(picked)]
    color = field.render(rays, generator).color
    predicted = srgb(color if gains is None else color * gains[rays.view - pool.first])
    target = srgb(rays.target[:, :3])
    counts = [len(pixels) for pixels in picked]
    square = torch.split((predicted - target).square().mean(1), counts)
    error = torch.split((target - predicted).mean(1), counts)
    psnr = [decibels(float(part.mean())) if len(part) >= FEWEST else math.nan for part in square]
    shift, halves = [], []
    for pixels, part in zip(picked, error, strict=True):
        column = pixels % pool.width
        left = column <= column.median() if len(pixels) else column.bool()
        shift.append(_shift(pool, pixels, part))
        halves.append(torch.stack([_shift(pool, pixels[half], part[half]) for half in (left, ~left)]))
    return Agreement(torch.tensor(psnr), torch.stack(shift), torch.stack(halves))


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
