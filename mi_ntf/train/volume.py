"""Volume rendering of collocated photographs (Bi et al. 2020), on packed samples.

Within a cell of length Δ and constant σ_j, with T_j the transmittance to its front,

    alpha weight    w_j = T_j (1 − e^{−σ_j Δ})                          = ∫ T σ dt
    light weight    v_j = T_j² (1 − e^{−2 σ_j Δ})/2                     = ∫ T·T σ dt

since light reaches a point on the camera's ray. Both are exact for any Δ, so pictures agree with those of a renderer
that marches finer. An opaque object has Σ v = 1/2: half of the light is absorbed in front of the mean scattering point.
:data:`SURFACE` compensates for this.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F

from ..core import fresnel, henyey_greenstein, microfacet
from . import ops
from .bounced import Bounced
from .flash import Flash
from .networks import Networks, Reflectance, density_from_log
from .optical import Optical
from .rays import Rays

SURFACE = 2.0
"""Ratio of ``microfacet.scattering`` to ``microfacet.lobes_collocated``. The field scatters with
ρ (⟨n,ω_i⟩ + ⟨n,ω_o⟩), which makes an opaque field look like a surface of reflectance ρ; collocated, 2ρ⟨n,ω_i⟩."""
MIN_WEIGHT = 1e-4
"""Alpha weight below which samples are not shaded."""
SPENT = 7.0
"""Optical depth behind which samples are left out: a thousandth of the pixel's alpha, a millionth of its light."""
STEEP = 0.3
"""Optical depth of a cell from which it and its neighbours are split."""
PARTS = 4
"""Number of parts of a split cell."""
ROUND = 12
"""Samples of a ray that are evaluated before spent rays are dropped."""


class Samples(NamedTuple):
    """Packed samples (s,), ordered along each ray."""

    ray: torch.Tensor  # Index of the ray, ascending
    t: torch.Tensor  # Distance along the ray
    width: torch.Tensor  # Length of the sample's cell


@dataclass(frozen=True)
class Image:
    """Rendered rays (n) and, for the losses, their shaded samples (s)."""

    color: torch.Tensor  # (n, 3), linear RGB
    alpha: torch.Tensor  # (n,)
    x: torch.Tensor  # Points of the shaded samples (s, 3)
    shaded: torch.Tensor  # Rays of the shaded samples (s,)
    index: torch.Tensor  # Indices of the shaded samples (s,) among all samples
    weight: torch.Tensor  # Alpha weights of the shaded samples (s,)
    reflectance: Reflectance  # Reflectance of the shaded samples
    radiance: torch.Tensor  # Radiance (s, 3) of the shaded samples, per light weight if the light is at the lens
    raw: torch.Tensor  # Unclipped ln σ of all samples
    bounced: torch.Tensor | float  # Part of `color` that did not come from the light directly


@torch.no_grad()
def unspent(networks: Networks, rays: Rays, cells: tuple[torch.Tensor, torch.Tensor], step: float,
            generator: torch.Generator) -> Samples:
    """Return samples at random places of the cells that lie in front of the optical depth SPENT.

    `cells` are packed ``(ray, near)`` of length `step`, see :meth:`mi_ntf.train.occupancy.Occupancy.visible`. Two of
    three lie deeper in the matter that the occupancy grid knows; one density without gradient decides. Where the
    density is high, skins are thinner than the cells. These cells and their neighbours are split: their noise would be
    learned as soft outlines.
    """
    ray, near = cells
    place = torch.arange(len(ray)) - torch.searchsorted(ray, ray)
    depth, thick, lit, first = torch.zeros(len(rays)), torch.zeros(len(ray)), [], 0
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
        lit.append(now[front < SPENT])
        thick[now] = here
        depth.index_add_(0, ray[now], here)
        rest = rest[(place[rest] >= first + ROUND) & (depth[ray[rest]] < SPENT)]
        first += ROUND
    index = torch.cat(lit).sort().values if lit else rest
    # The first and last cells of a ray have neighbours of other rays, and may be split without need.
    sharp = F.max_pool1d(F.pad(thick, (1, 1))[None], 3, 1)[0, index] > STEEP
    return _split(ray[index], near[index], step, torch.where(sharp, PARTS, 1), generator)


def _split(ray: torch.Tensor, near: torch.Tensor, step: float, parts: torch.Tensor, generator: torch.Generator
           ) -> Samples:
    """Return samples at random places of cells of length `step`, one in each of their `parts` (s,)."""
    first = (parts.cumsum(0) - parts).repeat_interleave(parts)
    ray, near, width = (v.repeat_interleave(parts) for v in (ray, near, step / parts))
    place = torch.arange(len(ray)) - first + torch.rand(len(ray), generator=generator)
    return Samples(ray, near + width * place, width)


def scatter_sum(value: torch.Tensor, ray: torch.Tensor, count: int) -> torch.Tensor:
    """Return the sums of the samples (s, …) over each of `count` rays."""
    return value.new_zeros(count, *value.shape[1:]).index_add(0, ray, value)


def shade(reflectance: Reflectance, d: torch.Tensor, t: torch.Tensor, light: torch.Tensor, retro: torch.Tensor | None,
          phase: float | None = None, tail: torch.Tensor | None = None) -> torch.Tensor:
    """Return the radiance (n, 3) that points scatter back along −d, per unit of light weight v.

    `t` (n,) is the distance to the light at the lens, `light` (n, 3) its radiant intensity. `retro` is the
    retro-reflection, None without a Fresnel term. `phase` is the asymmetry of smoke, which sends light back by its
    phase function alone. `tail` is that of the specular lobe, None for GGX.
    """
    if phase is not None:
        back = henyey_greenstein.phase(ops, phase, t.new_tensor(-1.0))
        smoke: torch.Tensor = back * reflectance.albedo * light / (t * t)[:, None]
        return smoke
    normal, albedo, roughness, specular = reflectance
    cos = -(normal * d).sum(1)
    diffuse, glossy = microfacet.lobes_collocated(ops, cos, roughness, tail)
    diffuse_weight, gloss_weight = fresnel.weights_collocated(ops, cos, roughness, specular.T, retro)
    lobe: torch.Tensor = (diffuse_weight * diffuse).T * albedo + (gloss_weight * glossy).T
    return SURFACE * lobe * light / (t * t)[:, None]


def render(networks: Networks, rays: Rays, samples: Samples, bounced: Bounced | None = None,
           generator: torch.Generator | None = None, lobes: bool = True, flash: Flash | None = None) -> Image:
    """Render colour and alpha of `rays` from packed samples.

    `bounced` are further bounces of the light, sampled with `generator`. Without `lobes`, roughness and specular weight
    get no gradient, and colours turn no normal away from the light: dark pixels then mean a dark albedo. Where a normal
    faces away from the light, neither of them would learn from colours any more. `flash` are lights beside the lenses;
    without it, the light is at the lens.
    """
    ray, t, width = samples
    x = torch.addcmul(rays.o[ray], rays.d[ray], t[:, None])
    raw = networks.log_density(x)
    optical = Optical.of(density_from_log(raw), ray, width)
    w, v = optical.weights()
    alpha = scatter_sum(w, ray, len(rays))
    near = (w.detach() > MIN_WEIGHT).nonzero()[:, 0]
    ray, t, x, w, view = ray[near], t[near], x[near], w[near], rays.view[ray[near]]
    reflectance = networks.reflectance(x)
    shaded, retro, tail = reflectance, networks.retro, networks.tail
    if not lobes:
        retro, tail = (None if v is None else v.detach() for v in (retro, tail))
        reflectance = Reflectance(*reflectance[:2], *(v.detach() for v in reflectance[2:]))
        shaded = reflectance._replace(normal=_turned_to(reflectance.normal, -rays.d[ray]))
    if flash is None:
        radiance = shade(shaded, rays.d[ray], t, rays.light[ray], retro, networks.phase, tail)
        color = scatter_sum(v[near, None] * radiance, ray, len(rays))
    else:
        radiance = flash.send(optical[near], shaded, rays.d[ray], x, view, rays.light[ray], retro, networks.phase,
                              tail)
        color = scatter_sum(radiance, ray, len(rays)) * _lit(flash, rays, ray, w.detach(), x, shaded.normal.detach())
    indirect: torch.Tensor | float = 0.0
    if bounced is not None and bounced.known:
        irradiance = bounced(view, x, shaded.normal, generator)
        radiosity = shaded.diffuse_albedo(networks.fresnel) * irradiance * microfacet.INV_PI
        indirect = scatter_sum(w[:, None] * radiosity, ray, len(rays))
        color = color + indirect
    return Image(color, alpha, x, ray, near, w, reflectance, radiance, raw, indirect)


def _turned_to(normal: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
    """Return `normal` (n, 3), whose gradient has no part that would turn it away from `light` (n, 3)."""
    result = normal.view_as(normal)
    if result.requires_grad:
        result.register_hook(lambda g: g - (g * light).sum(1, keepdim=True).clamp(min=0) * light)  # type: ignore[no-untyped-call]
    return result


def _lit(flash: Flash, rays: Rays, ray: torch.Tensor, w: torch.Tensor, x: torch.Tensor, normal: torch.Tensor
         ) -> torch.Tensor:
    """Return the fraction (n, 1) of the light that reaches the mean point that each ray sees."""
    both = scatter_sum(torch.cat([w[:, None] * x, w[:, None] * normal], 1), ray, len(rays))
    total = scatter_sum(w, ray, len(rays))
    hit = (total > MIN_WEIGHT).nonzero()[:, 0]
    fraction = torch.ones(len(rays), 1)
    fraction[hit, 0] = flash.lit(rays.view[hit], both[hit, :3] / total[hit, None], both[hit, 3:])
    return fraction
