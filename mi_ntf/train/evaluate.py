"""How well a field reproduces photographs: PSNR of images rendered as the renderer does, from the networks alone."""

import math

import torch

from . import device
from .networks import Networks
from .occupancy import Occupancy, from_networks
from .rays import Rays
from .render import render, scatter_sum, unspent

CUT = 0.1
"""The renderer treats σ below this as empty."""
CELLS = 128
"""Cells along an edge of the occupancy grid that finished fields are seen through."""


def srgb(x: torch.Tensor) -> torch.Tensor:
    """sRGB-encoded, clipped to [0, 1], of linear values."""
    x = x.clamp(0, 1)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp(min=1e-8) ** (1 / 2.4) - 0.055)


@torch.no_grad()
def render_all(networks: Networks, rays: Rays, occupancy: Occupancy, step: float, generator: torch.Generator,
               bounced=None, passes: int = 1, chunk: int = 8192):
    """``(color (n, 3), alpha (n,), normal (n, 3))`` of all rays; `passes` jittered evaluations are averaged; `bounced`
    as for :func:`render`."""
    index, kept = occupancy.tighten(rays)
    color, alpha, normal = torch.zeros(len(rays), 3), torch.zeros(len(rays)), torch.zeros(len(rays), 3)
    for first in range(0, len(kept), chunk):
        part = kept[slice(first, first + chunk)]
        where = index[first:first + chunk]
        for _ in range(passes):
            cells = occupancy.visible(part, step, generator)
            image = render(networks, part, unspent(networks, part, cells, step, generator), bounced, generator)
            color[where] += image.color / passes
            alpha[where] += image.alpha / passes
            normal[where] += scatter_sum(image.weight[:, None] * image.normal, image.shaded, len(part)) / passes
    return color, alpha, normal


def psnr(predicted: torch.Tensor, target: torch.Tensor, images: int) -> dict[str, float]:
    """Mean over `images` of their PSNR (dB): `srgb` of sRGB-encoded images clipped to [0, 1], as papers report it, and
    `linear` of linear ones with peak 1."""
    def mean(a, b):
        mse = (a - b).square().view(images, -1).mean(1).clamp(min=1e-12)
        return float((-10 * mse.log10()).mean())
    return {"srgb": mean(srgb(predicted), srgb(target)), "linear": mean(predicted, target)}


def occupied(networks: Networks) -> Occupancy:
    """Where the networks put matter, and be it outside the visual hull: a renderer sees that too."""
    return from_networks(networks, CELLS, CUT, device.generator(1))


def score(networks: Networks, occupancy: Occupancy, rays: Rays, images: int, step: float,
          bounced=None) -> dict[str, float]:
    """PSNR of a whole split; `occupancy`: of :func:`occupied`."""
    color, alpha, _ = render_all(networks, rays, occupancy, step, device.generator(1), bounced, passes=2)
    error = (alpha - rays.target[:, 3]).square().mean()
    return psnr(color, rays.target[:, :3], images) | {"alpha_rmse": math.sqrt(float(error))}
