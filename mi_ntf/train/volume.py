"""Volume rendering of collocated photographs (method.md, section 2), on packed samples.

Within a cell of length Δ and constant σ_j, with T_j the transmittance to its front,

    alpha weight    w_j = T_j (1 − e^{−σ_j Δ})                          = ∫ T σ dt
    light weight    v_j = T_j² (1 − e^{−2 σ_j Δ})/2                     = ∫ T·T σ dt

since the light's way to a point is the camera's. Both are exact for any Δ, so pictures agree with those of a renderer
that marches finer. An opaque object has Σ v = 1/2: half of the light is taken by matter that lies in front of the mean
scattering point. :data:`SURFACE` makes up for it.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..core import fresnel, microfacet
from . import ops
from .flash import Flash
from .networks import Networks, density_from_log
from .optical import Optical
from .rays import Rays

SURFACE = 2.0
"""``microfacet.scattering`` over ``microfacet.lobes_collocated``: the field scatters with ρ (⟨n,ω_i⟩ + ⟨n,ω_o⟩), which
makes an opaque field look like a surface of reflectance ρ from all sides; collocated, that is 2ρ⟨n,ω_i⟩, on curved
skins too."""
MIN_WEIGHT = 1e-4
"""Samples with a smaller alpha weight are not shaded."""
SPENT = 7.0
"""Optical depth behind which samples are left out: a thousandth of the pixel's alpha, a millionth of its light."""
STEEP = 0.3
"""Optical depth of a cell from which on it, and its neighbours, are split …"""
PARTS = 4
"""… into so many."""
ROUND = 12
"""Samples of a ray that are looked at before it is asked whether it is spent."""


@dataclass(frozen=True)
class Image:
    """Rendered rays and, for the losses, their shaded samples: of ray `shaded`, sample `index` of `raw`. `bounced`:
    what of `color` did not come from the flash directly."""

    color: torch.Tensor
    alpha: torch.Tensor
    x: torch.Tensor
    shaded: torch.Tensor
    index: torch.Tensor
    weight: torch.Tensor
    normal: torch.Tensor
    albedo: torch.Tensor
    gloss: tuple[torch.Tensor, torch.Tensor]
    radiance: torch.Tensor
    raw: torch.Tensor
    bounced: torch.Tensor | float


@torch.no_grad()
def unspent(networks: Networks, rays: Rays, cells, step: float, generator: torch.Generator):
    """Of packed cells ``(ray, near)`` of length `step` those in front of the optical depth SPENT, as samples
    ``(ray, t, width)``, a random place in each.

    Two of three lie deeper in the matter that the occupancy grid knows; finding out costs one look at the density of
    the others, without gradient. Where it is high, and in the cells before and behind, skins are thinner than the
    cells, which are split: their noise would be learned as soft outlines.
    """
    ray, near = cells
    place = torch.arange(len(ray)) - torch.searchsorted(ray, ray)
    depth, thick, kept, first = torch.zeros(len(rays)), torch.zeros(len(ray)), [], 0
    rest = torch.arange(len(ray))
    while len(rest):
        now = rest[place[rest] < first + ROUND]
        t = near[now] + step * torch.rand(len(now), generator=generator)
        x = torch.addcmul(rays.o[ray[now]], rays.d[ray[now]], t[:, None])
        here = networks.density(x) * step
        # Float64: the sum runs over all rays.
        total = here.double().cumsum(0)
        before = total - here
        front = depth[ray[now]] + (before - before[torch.searchsorted(ray[now], ray[now])]).float()
        kept.append(now[front < SPENT])
        thick[now] = here
        depth.index_add_(0, ray[now], here)
        rest = rest[(place[rest] >= first + ROUND) & (depth[ray[rest]] < SPENT)]
        first += ROUND
    index = torch.cat(kept).sort().values if kept else rest
    # The first and last cells of a ray have neighbours of other rays, and may be split without need.
    sharp = F.max_pool1d(F.pad(thick, (1, 1))[None], 3, 1)[0, index] > STEEP
    return _split(ray[index], near[index], step, torch.where(sharp, PARTS, 1), generator)


def _split(ray: torch.Tensor, near: torch.Tensor, step: float, parts: torch.Tensor, generator: torch.Generator):
    """Samples ``(ray, t, width)`` at random places of cells of length `step`, one in each of their `parts` (s,)."""
    first = (parts.cumsum(0) - parts).repeat_interleave(parts)
    ray, near, width = (v.repeat_interleave(parts) for v in (ray, near, step / parts))
    place = torch.arange(len(ray)) - first + torch.rand(len(ray), generator=generator)
    return ray, near + width * place, width


def scatter_sum(value: torch.Tensor, ray: torch.Tensor, count: int) -> torch.Tensor:
    """Sum the samples (s, …) of each of `count` rays."""
    return value.new_zeros(count, *value.shape[1:]).index_add(0, ray, value)


def shade(reflectance: tuple, d: torch.Tensor, t: torch.Tensor, light: torch.Tensor, rim: bool) -> torch.Tensor:
    """What points of this `reflectance` scatter back along −d per unit of light weight v: radiance (n, 3). `rim`:
    whether the field has a Fresnel term."""
    normal, albedo, roughness, specular = reflectance
    cos = -(normal * d).sum(1)
    diffuse, glossy = microfacet.lobes_collocated(ops, cos, roughness)
    of_diffuse, of_gloss = fresnel.weights_collocated(ops, cos, roughness, specular, rim)
    lobe = (of_diffuse * diffuse)[:, None] * albedo + (of_gloss * glossy)[:, None]
    return SURFACE * lobe * light / (t * t)[:, None]


def diffuse_albedo(reflectance: tuple, rim: bool) -> torch.Tensor:
    """Albedo (n, 3) of diffuse surfaces that reflect as much of light from everywhere. `rim`: as for :func:`shade`."""
    _, albedo, roughness, specular = reflectance
    return fresnel.diffuse_albedo(ops, albedo, roughness[:, None], specular[:, None], rim)


def render(networks: Networks, rays: Rays, samples, bounced=None, generator: torch.Generator | None = None,
           lobes: bool = True, flash: Flash | None = None) -> Image:
    """Colour and alpha of `rays` from packed samples ``(ray, t, width)``, each in a cell of its width.

    `bounced` (:class:`mi_ntf.train.bounced.Bounced`, drawn from by `generator`): further bounces of the flashes' light.
    `lobes`: whether roughness and specular weight have derivatives. `flash`: where the light comes from; the lens,
    unless told.
    """
    ray, t, width = samples
    x = torch.addcmul(rays.o[ray], rays.d[ray], t[:, None])
    raw = networks.log_density(x)
    seen = Optical.of(density_from_log(raw), ray, width)
    w, v = seen.weights()
    alpha = scatter_sum(w, ray, len(rays))
    near = (w.detach() > MIN_WEIGHT).nonzero()[:, 0]
    ray, t, x, w, view = ray[near], t[near], x[near], w[near], rays.view[ray[near]]
    reflectance = networks.reflectance(x)
    if not lobes:
        reflectance = *reflectance[:2], *(v.detach() for v in reflectance[2:])
    if flash is None:
        radiance = shade(reflectance, rays.d[ray], t, rays.light[ray], networks.fresnel)
        color = scatter_sum(v[near, None] * radiance, ray, len(rays))
    else:
        radiance = flash.send(seen[near], reflectance, rays.d[ray], x, view, rays.light[ray], networks.fresnel)
        color = scatter_sum(radiance, ray, len(rays)) * _lit(flash, rays, ray, w.detach(), x, reflectance[0].detach())
    indirect: torch.Tensor | float = 0.0
    if bounced is not None and bounced.known:
        irradiance = bounced(view, x, reflectance[0], generator)
        sent = diffuse_albedo(reflectance, networks.fresnel) * irradiance * microfacet.INV_PI
        indirect = scatter_sum(w[:, None] * sent, ray, len(rays))
        color = color + indirect
    normal, albedo, *gloss = reflectance
    return Image(color, alpha, x, ray, near, w, normal, albedo, tuple(gloss), radiance, raw, indirect)


def _lit(flash: Flash, rays: Rays, ray: torch.Tensor, w: torch.Tensor, x: torch.Tensor, normal: torch.Tensor):
    """Share (n, 1) of the flash's light that reaches what each of the rays sees."""
    both = scatter_sum(torch.cat([w[:, None] * x, w[:, None] * normal], 1), ray, len(rays))
    total = scatter_sum(w, ray, len(rays))
    some = (total > MIN_WEIGHT).nonzero()[:, 0]
    found = torch.ones(len(rays), 1)
    found[some, 0] = flash.lit(rays.view[some], both[some, :3] / total[some, None], both[some, 3:])
    return found
