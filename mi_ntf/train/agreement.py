"""Whether photographs agree with each other: what is left between each of them and the field that all of them made."""

import math
from dataclasses import dataclass

import torch

from . import device
from .networks import Networks
from .occupancy import Occupancy
from .rays import Photographs
from .scoring import Light, decibels, render_all, srgb

PIXELS = 1000
"""Pixels looked at of each photograph …"""
FEWEST = 250
"""… and at least, where there is little time."""
KNOWN = 20.0
"""dB of the median photograph from which on a field knows the object well enough to tell of the photographs."""
BEHIND = 5.0
"""dB under the median, and three times the usual spread, from which on a photograph disagrees with the others."""
FEWEST = 50
"""Pixels of a photograph that tell anything."""
MATTER = 0.9
"""Alpha from which on a pixel is the object's."""
MOVED = 0.25
"""Pixels, root mean square, by which photographs are shifted against the field from which on poses are inexact: 0.07
with exact poses (`statue`), 0.5 where they are 1.3 pixels off, half of which the field follows."""


@dataclass(frozen=True)
class Agreement:
    """`psnr`: dB of the object's pixels of each photograph for training · `shift` (views, 2): pixels by which each is
    moved against the field, right and down."""

    psnr: torch.Tensor
    shift: torch.Tensor

    @property
    def moved(self) -> float:
        """Root mean square of the shifts' lengths; the mean shift is the field's own."""
        apart = self.shift - self.shift.median(0).values
        return float(apart.square().sum(1).mean().sqrt())

    @property
    def known(self) -> bool:
        """Whether the field has learned enough to judge."""
        return bool(self.psnr.nanmedian() > KNOWN)

    def outliers(self) -> list[int]:
        """Photographs that the others contradict."""
        middle = self.psnr.nanmedian()
        spread = (self.psnr - middle).abs().nanmedian()
        return ((middle - self.psnr) > torch.clamp(4.5 * spread, min=BEHIND)).nonzero()[:, 0].tolist()


@torch.no_grad()
def survey(networks: Networks, occupancy: Occupancy, pool: Photographs, gains: torch.Tensor | None, step: float,
           light: Light, most: float = math.inf) -> Agreement:
    """Compare some pixels of all photographs with the field, `most` or so in all; `gains` (views, 3): theirs."""
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
        color, *_ = render_all(networks, rays, occupancy, step, generator, light)
        found = srgb(color if gains is None else color * gains[number])
        target = srgb(rays.target[:, :3])
        psnr.append(decibels(float((found - target).square().mean())))
        shift.append(_shift(pool, pixels, (target - found).mean(1)))
    return Agreement(torch.tensor(psnr), torch.stack(shift))


def _shift(pool: Photographs, pixels: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """By which (2,) pixels a photograph is moved, from its `error` (n,) at `pixels` (n,) and its own slopes: least
    squares (Lucas and Kanade 1981), twice, the second time without the largest errors."""
    def beside(offset: int) -> tuple[torch.Tensor, torch.Tensor]:
        found = pool.pixels((pixels + offset).clamp(0, len(pool) - 1))
        return srgb(found[:, :3]).mean(1), found[:, 3] > MATTER

    (left, a), (right, b), (above, c), (below, d) = (beside(step) for step in (-1, 1, -pool.width, pool.width))
    # The outline's slopes are the largest of all, and half of its errors are in pixels that are not looked at.
    inside = a & b & c & d
    slope, error = torch.stack([right - left, below - above], 1)[inside] / 2, error[inside]
    kept, found = torch.ones_like(error), torch.zeros(2)
    for _ in range(2 if len(error) >= FEWEST else 0):
        weighted = slope * kept[:, None]
        found = torch.linalg.solve(weighted.T @ slope + 1e-4 * torch.eye(2), weighted.T @ -error)
        rest = (error + slope @ found).abs()
        kept = (rest < 3 * rest.median()).float()
    return found
