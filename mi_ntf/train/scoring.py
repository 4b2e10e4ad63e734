"""Reproduction error of photographs: PSNR of images rendered from the networks alone, as the renderer does."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from ..core import srgb as curve
from . import device, ops
from .bounced import Bounced
from .flash import Flash
from .networks import Networks
from .occupancy import Occupancy, from_networks
from .photometry import fitted
from .rays import Photographs, Rays
from .transmittance_targets import CUT
from .volume import render, scatter_sum, unspent

CELLS = 128
"""Cells along an edge of the occupancy grid of finished fields."""


def srgb(x: torch.Tensor) -> torch.Tensor:
    """Return the sRGB encoding of linear values, clipped to [0, 1]."""
    encoded: torch.Tensor = curve.encode(ops, x)
    return encoded


@dataclass(frozen=True)
class Light:
    """Light of the photographs, besides a flash at the lens."""

    bounced: Bounced | None = None  # Further bounces of the flash's light
    flash: Flash | None = None
    """Lights beside the lenses; None: all are at the lens."""
    fit: bool = False  # True if each photograph has gains, which are fitted to held-out photographs


class Pixels(NamedTuple):
    """Rendered pixels of n rays."""

    color: torch.Tensor  # (n, 3), linear RGB
    alpha: torch.Tensor  # (n,)
    normal: torch.Tensor  # (n, 3), premultiplied
    albedo: torch.Tensor  # (n, 3), premultiplied


@dataclass(frozen=True)
class FieldView:
    """A field with all that is needed to render photographs of it."""

    networks: Networks
    occupancy: Occupancy
    step: float  # Length of the quadrature's cells
    light: Light = Light()

    @torch.no_grad()
    def render(self, rays: Rays, generator: torch.Generator, passes: int = 1, chunk: int = 8192) -> Pixels:
        """Render all `rays`; `passes` jittered evaluations are averaged."""
        index, meeting = self.occupancy.tighten(rays)
        total = torch.zeros(len(rays), 10)
        for first in range(0, len(meeting), chunk):
            part = meeting[slice(first, first + chunk)]
            rows = index[first:first + chunk]
            for _ in range(passes):
                cells = self.occupancy.visible(part, self.step, generator)
                samples = unspent(self.networks, part, cells, self.step, generator)
                image = render(self.networks, part, samples, self.light.bounced, generator, flash=self.light.flash)
                surface = torch.cat([image.reflectance.normal, image.reflectance.albedo], 1)
                surface = scatter_sum(image.weight[:, None] * surface, image.shaded, len(part))
                total[rows] += torch.cat([image.color, image.alpha[:, None], surface], 1) / passes
        return Pixels(total[:, :3], total[:, 3], total[:, 4:7], total[:, 7:])


@dataclass(frozen=True)
class Scores:
    """Means over photographs of their PSNR in dB, and the error of alpha."""

    srgb: float  # PSNR of sRGB-encoded images clipped to [0, 1], as papers report it
    linear: float  # PSNR of linear images with peak 1
    object: float  # As `srgb`, of the object's pixels alone
    alpha_rmse: float
    each: tuple[float, ...]  # `srgb` of each photograph

    def rounded(self) -> dict[str, float]:
        """Return the means, rounded for the report."""
        return {"srgb": round(self.srgb, 3), "linear": round(self.linear, 3), "object": round(self.object, 3),
                "alpha_rmse": round(self.alpha_rmse, 5)}


def decibels(mean_square: float) -> float:
    """Return the PSNR of a mean squared error, of peak 1."""
    return -10 * math.log10(max(mean_square, 1e-12))


def occupied(networks: Networks) -> Occupancy:
    """Return the occupancy of finished networks; like a renderer, it sees matter outside the visual hull, too."""
    return from_networks(networks, CELLS, CUT, device.generator(1))


@torch.no_grad()
def score(field: FieldView, photographs: Photographs, most: float = math.inf, views: int | None = None,
          passes: int = 2) -> Scores:
    """Compare the field with the photographs of a split, or the first `views` of them.

    At most `most` pixels are compared, random ones, the same in every call. Each is the mean of `passes` jittered
    evaluations.
    """
    count = photographs.views if views is None else min(views, photographs.views)
    each, generator = [], device.generator(1)
    for number in range(count):
        pixels, *_ = photographs.frame(number)
        if len(pixels) * count > most:
            pick = torch.randperm(len(pixels), generator=device.generator(6))[:max(1, int(most / count))]
            pixels = pixels[pick]
        rays = photographs[pixels]
        color, alpha, *_ = field.render(rays, generator, passes)
        target = rays.target
        color = color * fitted(color, target[:, :3]) if field.light.fit else color
        matter = target[:, 3] > (0.5 if photographs.masked else 0.99)
        error = (srgb(color) - srgb(target[:, :3])).square().mean(1)
        known = matter | (target[:, 3] == 0) if not photographs.masked else torch.ones_like(matter)
        each.append((decibels(float(error.mean())), decibels(float((color - target[:, :3]).square().mean())),
                     decibels(float(error[matter].mean())) if bool(matter.any()) else math.nan,
                     float((alpha - target[:, 3])[known].square().mean())))
    whole, linear, object_, mean_square = torch.tensor(each).T
    return Scores(float(whole.mean()), float(linear.mean()), float(object_.nanmean()),
                  math.sqrt(float(mean_square.nanmean())), tuple(whole.tolist()))
