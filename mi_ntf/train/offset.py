"""Where a flash stands that goes along with the camera, from the shading that many views see at the same points.

A point i of the surface, seen in photograph v, has

    ln I = a_i + g_v + ln ⟨n_i, ω_i⟩⁺ − 2 ln d_i,        I the geometric mean of its three channels,

with a_i its albedo and g_v the photograph's exposure, whatever they and the white balance are: only the light's place
in the camera's axes is common to all photographs. For a place that is tried a and g are means of what is left, and the
place with the least left is the flash's. Points in shadow and highlights are outliers, which a robust cost ignores.
"""

from dataclasses import dataclass

import torch

from .flash import Flash, above
from .normal_targets import NormalTargets
from .rays import Photographs, Rays
from .transmittance_targets import TransmittanceTargets, walk

POINTS = 3000
FEWEST = 100
"""Points that tell anything."""
SPREAD = 0.12
"""Errors of ln I beyond this hardly count (Geman and McClure): noise and slightly wrong normals are within."""
LEAST = 0.05
"""Cosine that darker shading counts as."""
WIDEST = 0.9
"""Offsets tried, over the camera's distance: 42°."""
SEEN = 0.35
"""Cosine to the viewer from which on a point is used."""


@dataclass(frozen=True)
class Observed:
    """`x`, `normal` (p, 3) of surface points · `value` (views, p): ln I of each in each photograph · `used` (views, p):
    1 where it is seen."""

    x: torch.Tensor
    normal: torch.Tensor
    value: torch.Tensor
    used: torch.Tensor


@torch.no_grad()
def observe(pool: Photographs, rays: Rays, baked: NormalTargets, marched: TransmittanceTargets) -> Observed:
    """What the photographs show of the points that some camera `rays` meet."""
    t, _ = walk(marched, rays.o, rays.d, 0.7)
    met = t.isfinite().nonzero()[:POINTS, 0]
    x = torch.addcmul(rays.o[met], rays.d[met], t[met, None])
    normal, certain = baked.normals(x)
    x, normal = x[certain], normal[certain]
    value, used = torch.zeros(pool.views, len(x)), torch.zeros(pool.views, len(x))
    for number in range(pool.views):
        origin = pool.origin[number].float()
        away = origin - x
        distance = away.norm(dim=1)
        toward = away / distance[:, None]
        local = (-away.double()) @ pool.rotation[number]
        place = local[:, :2] / -local[:, 2:] * torch.tensor([1.0, -1.0]) * pool.focal[number] + pool.principal[number]
        column, row = place.floor().long().unbind(1)
        inside = (local[:, 2] < 0) & (column >= 0) & (column < pool.width) & (row >= 0) & (row < pool.height)
        inside &= (toward * normal).sum(1) > SEEN
        some = inside.nonzero()[:, 0]
        _, depth = walk(marched, above(marched, x[some], normal[some]), toward[some], 2.0, distance[some])
        pixels = pool.pixels((number * pool.height + row[some]) * pool.width + column[some])
        color = pixels[:, :3]
        good = (depth < 0.5) & (pixels[:, 3] > 0.99) & (color.amin(1) > 1e-3)
        good &= (color.amax(1) < 0.95) if pool.levels else True
        value[number, some] = color.clamp(min=1e-6).log().mean(1)
        used[number, some] = good.float()
    enough = used.sum(0) >= 3
    return Observed(x[enough], normal[enough], value[:, enough], used[:, enough])


def cost(seen: Observed, place: torch.Tensor) -> float:
    """How badly lights at `place` (views, 3) explain what is `seen`: mean robust error, 0 to 1."""
    away = place[:, None] - seen.x
    distance = away.norm(dim=2)
    cosine = (away * seen.normal).sum(2) / distance
    rest = seen.value - cosine.clamp(min=LEAST).log() + 2 * distance.log()
    weight = seen.used
    albedo, gain = torch.zeros(rest.shape[1]), torch.zeros(rest.shape[0])
    for _ in range(8):
        gain = (weight * (rest - albedo)).sum(1) / weight.sum(1).clamp(min=1e-6)
        albedo = (weight * (rest - gain[:, None])).sum(0) / weight.sum(0).clamp(min=1e-6)
        square = ((rest - gain[:, None] - albedo) / SPREAD).square()
        weight = seen.used / (1 + square).square()
    return float((seen.used * square / (1 + square)).sum() / seen.used.sum().clamp(min=1))


def estimate(seen: Observed, flash: Flash, views: int, distance: float) -> torch.Tensor | None:
    """Right and up of the lens, forward 0 (3,), field lengths, of the light of the first `views` photographs of
    `flash`, whose cameras are about `distance` from the object. None where points are too few."""
    if seen.x.shape[0] < FEWEST:
        return None

    def best(around: torch.Tensor, step: float, reach: int) -> torch.Tensor:
        side = range(-reach, reach + 1)
        tried = [around + step * torch.tensor([float(i), float(j), 0.0]) for i in side for j in side]
        return min(tried, key=lambda offset: cost(seen, flash.places(offset)[:views]))

    step = WIDEST * distance / 4
    offset = best(torch.zeros(3), step, 4)
    while step > 0.004 * distance:
        step /= 2
        offset = best(offset, step, 1)
    return offset
