"""How well a field reproduces photographs: PSNR of images rendered as the renderer does, from the networks alone."""

import math
from dataclasses import dataclass

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
"""Cells along an edge of the occupancy grid that finished fields are seen through."""


def srgb(x: torch.Tensor) -> torch.Tensor:
    """sRGB-encoded, clipped to [0, 1], of linear values."""
    return curve.encode(ops, x)


@dataclass(frozen=True)
class Light:
    """What lights the photographs besides a flash at the lens: further bounces, and where the flash is if it is
    elsewhere. `fit`: whether each photograph has gains of its own, which those held back are fitted."""

    bounced: Bounced | None = None
    flash: Flash | None = None
    fit: bool = False


@torch.no_grad()
def render_all(networks: Networks, rays: Rays, occupancy: Occupancy, step: float, generator: torch.Generator,
               light: Light = Light(), passes: int = 1, chunk: int = 8192):
    """``(color (n, 3), alpha (n,), normal (n, 3), albedo (n, 3))`` of all rays; `passes` jittered evaluations are
    averaged."""
    index, kept = occupancy.tighten(rays)
    found = torch.zeros(len(rays), 10)
    for first in range(0, len(kept), chunk):
        part = kept[slice(first, first + chunk)]
        where = index[first:first + chunk]
        for _ in range(passes):
            cells = occupancy.visible(part, step, generator)
            image = render(networks, part, unspent(networks, part, cells, step, generator), light.bounced, generator,
                           flash=light.flash)
            seen = torch.cat([image.normal, image.albedo], 1)
            seen = scatter_sum(image.weight[:, None] * seen, image.shaded, len(part))
            found[where] += torch.cat([image.color, image.alpha[:, None], seen], 1) / passes
    return found[:, :3], found[:, 3], found[:, 4:7], found[:, 7:]


def decibels(mean_square: float) -> float:
    """PSNR of peak 1."""
    return -10 * math.log10(max(mean_square, 1e-12))


def occupied(networks: Networks) -> Occupancy:
    """Where the networks put matter, and be it outside the visual hull: a renderer sees that too."""
    return from_networks(networks, CELLS, CUT, device.generator(1))


@torch.no_grad()
def score(networks: Networks, occupancy: Occupancy, photographs: Photographs, step: float, light: Light = Light(),
          most: float = math.inf, views: int | None = None, passes: int = 2, tell=lambda done: None) -> dict:
    """How near the field comes to the photographs of a split, or the first `views` of them.

    Means over photographs of their PSNR in dB: `srgb` of sRGB-encoded images clipped to [0, 1], as papers report it,
    `linear` of linear ones with peak 1, `object` as `srgb`, of the object's pixels alone; and `alpha_rmse`. Each
    photograph's own `srgb` is in `each`. At most `most` pixels are looked at, random ones, the same in every call.
    `tell` is called with the share that is done.
    """
    count = photographs.views if views is None else min(views, photographs.views)
    each, generator = [], device.generator(1)
    for number in range(count):
        pixels, *_ = photographs.frame(number)
        if len(pixels) * count > most:
            some = torch.randperm(len(pixels), generator=device.generator(6))[:max(1, int(most / count))]
            pixels = pixels[some]
        rays = photographs[pixels]
        color, alpha, *_ = render_all(networks, rays, occupancy, step, generator, light, passes)
        target = rays.target
        color = color * fitted(color, target[:, :3]) if light.fit else color
        matter = target[:, 3] > (0.5 if photographs.masked else 0.99)
        error = (srgb(color) - srgb(target[:, :3])).square().mean(1)
        known = matter | (target[:, 3] == 0) if not photographs.masked else torch.ones_like(matter)
        each.append((decibels(float(error.mean())), decibels(float((color - target[:, :3]).square().mean())),
                     decibels(float(error[matter].mean())) if bool(matter.any()) else math.nan,
                     float((alpha - target[:, 3])[known].square().mean())))
        tell((number + 1) / count)
    srgb_, linear, object_, mean_square = torch.tensor(each).T
    return {"srgb": float(srgb_.mean()), "linear": float(linear.mean()), "object": float(object_.nanmean()),
            "alpha_rmse": math.sqrt(float(mean_square.nanmean())), "each": srgb_.tolist()}
