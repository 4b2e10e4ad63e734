"""Position of a flash that moves with the camera, from the shading that many views see at the same points.

A point i of the surface, seen in photograph v, has

    ln I = a_i + g_v + ln ⟨n_i, ω_i⟩⁺ − 2 ln d_i,        I the geometric mean of its three channels,

with the albedo a_i and the photograph's exposure g_v. Only the position of the light in the camera's axes is common to
all photographs. For each trial position a and g are means of the residual, and the position with the least residual is
the flash's. Points in shadow and highlights are outliers, which a robust cost ignores.
"""

from dataclasses import dataclass

import torch

from .flash import Flash, above
from .normal_targets import NormalTargets
from .rays import Photographs, Rays
from .transmittance_targets import TransmittanceTargets, walk

POINTS = 3000
"""Largest number of points that are observed."""
FEWEST = 100
"""Least number of points from which a position is estimated."""
SPREAD = 0.12
"""Scale of the robust cost (Geman and McClure): larger errors of ln I hardly count. Noise and slightly wrong normals
are below it."""
LEAST = 0.05
"""Least cosine of incidence; darker shading counts as this."""
WIDEST = 0.9
"""Largest offset that is tried, relative to the camera's distance: 42°."""
FACING = 0.35
"""Cosine to the viewer above which a point is used."""


@dataclass(frozen=True)
class Observed:
    """Brightness of p surface points in all photographs."""

    x: torch.Tensor  # Points (p, 3)
    normal: torch.Tensor  # Unit normals (p, 3)
    value: torch.Tensor  # ln I (views, p)
    used: torch.Tensor  # 1 where a photograph shows the point (views, p), else 0


@torch.no_grad()
def observe(pool: Photographs, rays: Rays, baked: NormalTargets, marched: TransmittanceTargets) -> Observed:
    """Read the surface points that camera `rays` hit from all photographs that show them."""
    t, _ = walk(marched, rays.o, rays.d, 0.7)
    hit = t.isfinite().nonzero()[:POINTS, 0]
    x = torch.addcmul(rays.o[hit], rays.d[hit], t[hit, None])
    normal, certain = baked.normals(x)
    x, normal = x[certain], normal[certain]
    value, used = torch.zeros(pool.views, len(x)), torch.zeros(pool.views, len(x))
    for number in range(pool.views):
        path = pool.origin[number].float() - x
        distance = path.norm(dim=1)
        toward = path / distance[:, None]
        local = (-path.double()) @ pool.rotation[number]
        place = local[:, :2] / -local[:, 2:] * torch.tensor([1.0, -1.0]) * pool.focal[number] + pool.principal[number]
        column, row = place.floor().long().unbind(1)
        inside = (local[:, 2] < 0) & (column >= 0) & (column < pool.width) & (row >= 0) & (row < pool.height)
        inside &= (toward * normal).sum(1) > FACING
        shown = inside.nonzero()[:, 0]
        _, depth = walk(marched, above(marched, x[shown], normal[shown]), toward[shown], 2.0, distance[shown])
        pixels = pool.pixels((number * pool.height + row[shown]) * pool.width + column[shown])
        color = pixels[:, :3]
        good = (depth < 0.5) & (pixels[:, 3] > 0.99) & (color.amin(1) > 1e-3)
        good &= (color.amax(1) < 0.95) if pool.quantized else True
        value[number, shown] = color.clamp(min=1e-6).log().mean(1)
        used[number, shown] = good.float()
    enough = used.sum(0) >= 3
    return Observed(x[enough], normal[enough], value[:, enough], used[:, enough])


def cost(observed: Observed, place: torch.Tensor) -> float:
    """Return the mean robust error, 0 to 1, of lights at `place` (views, 3)."""
    path = place[:, None] - observed.x
    distance = path.norm(dim=2)
    cosine = (path * observed.normal).sum(2) / distance
    rest = observed.value - cosine.clamp(min=LEAST).log() + 2 * distance.log()
    weight = observed.used
    albedo, gain = torch.zeros(rest.shape[1]), torch.zeros(rest.shape[0])
    for _ in range(8):
        gain = (weight * (rest - albedo)).sum(1) / weight.sum(1).clamp(min=1e-6)
        albedo = (weight * (rest - gain[:, None])).sum(0) / weight.sum(0).clamp(min=1e-6)
        square = ((rest - gain[:, None] - albedo) / SPREAD).square()
        weight = observed.used / (1 + square).square()
    return float((observed.used * square / (1 + square)).sum() / observed.used.sum().clamp(min=1))


def estimate(observed: Observed, flash: Flash, views: int, distance: float) -> torch.Tensor | None:
    """Return the position (3,) of the light relative to the lens: right, up, and forward, which is 0; field lengths.

    `views` is the number of photographs that were observed, the first ones of `flash`; `distance` is about that of
    their cameras. Return None if there are too few points.
    """
    if observed.x.shape[0] < FEWEST:
        return None

    def best(around: torch.Tensor, step: float, reach: int) -> torch.Tensor:
        side = range(-reach, reach + 1)
        trials = [around + step * torch.tensor([float(i), float(j), 0.0]) for i in side for j in side]
        return min(trials, key=lambda offset: cost(observed, flash.places(offset)[:views]))

    step = WIDEST * distance / 4
    offset = best(torch.zeros(3), step, 4)
    while step > 0.004 * distance:
        step /= 2
        offset = best(offset, step, 1)
    return offset
