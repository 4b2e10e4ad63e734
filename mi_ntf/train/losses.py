"""Loss terms (Shafiei et al. 2021). Each is a mean over rays, samples or points, a 0-d tensor."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..core import mixture, spheres
from ..core.architecture import MAX_LOG_DENSITY
from . import ops
from .networks import Networks, depth_at, free_flight
from .normal_targets import NormalTargets
from .occupancy import LOG_EMPTY
from .rays import Rays
from .transmittance_targets import TransmittanceTargets, chords, random_chords, uniform_directions
from .volume import Image, scatter_sum

DARK = 0.05
"""Brightness, relative to the bright parts of the photographs, below which errors count absolutely."""
ROUGH = 60.0
"""Ratio of the cost of the roughest lobe to that of a sharp one."""
FAINT = -5.0
"""ln of the specular weight below which it is pulled back: further down its sigmoid has no slope."""
STEPS = 640
"""Steps of the marches from which transmittance is learned. They resolve the decay of light inside of skins, which are
0.005 wide and whose brightness depends on it."""


def color(predicted: torch.Tensor, target: torch.Tensor, exposure: float,
          trust: torch.Tensor | float = 1.0) -> torch.Tensor:
    """Return (p − t)²/(p + DARK) of exposed linear RGB: the squared error of square-root tones, to first order.

    The denominator is detached, so the minimum is the mean of noisy targets (Mildenhall et al. 2022, eq. 4). `trust`
    (n, 3) are the weights of the channels.
    """
    p, t = predicted * exposure, target * exposure
    return (trust * (p - t) ** 2 / (p.detach() + DARK)).mean()


def normals(image: Image, d: torch.Tensor, baked: NormalTargets) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the error of normals and the penalty of normals that face backwards (Verbin et al. 2022, eqs. 10, 11).

    The error is the distance to the density's normals. `d` (n, 3) are the rays. Weights are detached, so that normals
    do not thin the matter.
    """
    w, normal = image.weight.detach(), image.reflectance.normal
    expected, certain = baked.normals(image.x)
    count = len(d)
    error = (w * certain * (1 - (expected * normal).sum(1))).sum() / count
    backward = (normal * d[image.shaded]).sum(1).clamp(min=0)
    return error, (w * backward**2).sum() / count


def gloss(image: Image, least: float, fading: float, count: int) -> torch.Tensor:
    """Return the cost of specular weight s above its `least` value, (`fading` + ROUGH α⁴) s per ray, α = roughness².

    Under a flash, a lobe of α = 1 adds the same light as a diffuse lobe of a quarter of its weight. Under other lights
    only the diffuse one is right. Only sharp lobes explain sharp highlights, so their cost may fade during training.
    Vanishing weights cost (FAINT − ln s)²/10. `count` is the number of rays.
    """
    roughness = image.reflectance.roughness
    specular = (image.reflectance.specular - least) / (1 - least)
    lost = torch.relu(FAINT - specular.clamp(min=1e-30).log()).square().mean(1)
    specular = specular.mean(1)
    return (image.weight.detach() * (specular * (fading + ROUGH * roughness**8) + 0.1 * lost)).sum() / count


def evenness(networks: Networks, image: Image, length: float, count: int, generator: torch.Generator) -> torch.Tensor:
    """Return the squared change of ln σ along the surface, in random directions perpendicular to detached normals.

    Photographs with the light at the lens hardly show small bumps of the density, since nothing is in shadow. Under
    other lights bumps shade each other and show as blotches. Differences are taken over a quarter of `length` to all
    of it, at `count` samples. Smoke has no normals, so its directions are uniform: noise of the photographs would be
    learned as streaks.
    """
    visible = (image.weight.detach() > 0.02).nonzero()[:, 0]
    if not len(visible):
        return image.weight.sum() * 0
    pick = visible[torch.randint(len(visible), (count,), generator=generator)]
    along = uniform_directions(count, generator)
    if networks.phase is None:
        normal = image.reflectance.normal[pick].detach()
        along = F.normalize(torch.linalg.cross(normal, along), dim=1)
    offset = along * length * (0.25 + 0.75 * torch.rand(count, 1, generator=generator))
    x = image.x[pick]
    raw = networks.log_density(torch.cat([x + offset, x - offset])).clamp(LOG_EMPTY, MAX_LOG_DENSITY)
    return (raw[:count] - raw[count:]).square().mean()


def emptiness(networks: Networks, x: torch.Tensor) -> torch.Tensor:
    """Return a hinge on ln σ at points `x` that must be empty; its gradient ends at a third of LOG_EMPTY's σ."""
    return F.relu(networks.log_density(x) - (LOG_EMPTY - 1)).mean()


def total_variation(networks: Networks) -> torch.Tensor:
    """Return the mean squared difference of neighbouring texels of the field's planes, per texel width of 1/128."""
    terms = []
    for name, p in networks.tensors.items():
        if ".planes." in name and not name.startswith("transmittance"):
            scale = (p.shape[1] / 128) ** 2
            down, across = p[:, 1:] - p[:, :-1], p[:, :, 1:] - p[:, :, :-1]
            terms.append(scale * (down.square().mean() + across.square().mean()))
    return torch.stack(terms).sum()


def tau(mix: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Return τ (n, k) at places `t` (n, k) of the rays' mixtures (n, K, 3)."""
    parts = (part[:, :, None].unbind(1) for part in mix.unbind(1))
    value: torch.Tensor = mixture.transmittance(ops, t, tuple((w, a, b) for w, a, b in parts))
    return value


@dataclass(frozen=True)
class Targets:
    """Transmittance that is to be learned, on n rays, without gradient.

    Of each ray's 33 places 16 are uniform, and 16 lie where free flight from the light would end: lit surfaces are seen
    there, and a fit that is right on average over the chord is dark in the first half of the skin. The last is `o`.
    """

    o: torch.Tensor  # Points (n, 3) on the rays
    d: torch.Tensor  # Directions (n, 3) towards the light
    depth: torch.Tensor  # Marched profiles (n, STEPS + 1), see :meth:`TransmittanceTargets.march`
    t: torch.Tensor  # Places (n, 33) on the chords
    tau: torch.Tensor  # Transmittance (n, 33) there

    def error(self, predicted: torch.Tensor) -> torch.Tensor:
        """Return Σ (τ_nrf − τ_nt)² of `predicted` (n, 33), with means of the three kinds."""
        error = (predicted - self.tau) ** 2
        return error[:, :16].mean() + error[:, 16:32].mean() + error[:, 32].mean()


def targets(marched: TransmittanceTargets, o: torch.Tensor, d: torch.Tensor, generator: torch.Generator) -> Targets:
    """March rays through the points `o` (n, 3) along `d` towards the light through the baked density."""
    m, h = chords(o, d)
    depth = marched.march(m, d, h, STEPS)
    uniform = (2 * torch.rand(len(o), 16, generator=generator) - 1) * h[:, None]
    flight = free_flight(depth, h, 16, generator)
    t = torch.cat([uniform, flight, spheres.coordinate(o.unbind(1), d.unbind(1))[:, None]], 1)
    return Targets(o, d, depth, t, torch.exp(-depth_at(depth, h, t)))


def transmittance(networks: Networks, rays: Targets) -> torch.Tensor:
    """Return the error of the transmittance network; rays that miss the sphere have none."""
    hit, mix = networks.ray_mixture(rays.o, rays.d, rays.depth)
    return rays.error(torch.where(hit[:, None], tau(mix, rays.t), rays.tau))


def visibility(networks: Networks, rays: Targets) -> torch.Tensor:
    """Return the error of the baseline's network, which is evaluated at every place on its own."""
    along = rays.t - (rays.o * rays.d).sum(1, keepdim=True)
    x = rays.o[:, None] + along[:, :, None] * rays.d[:, None]
    predicted = networks.visibility(x.reshape(-1, 3), rays.d.repeat_interleave(rays.t.shape[1], 0))
    return rays.error(predicted.view(rays.t.shape))


def training_rays(marched: TransmittanceTargets, rays: Rays, count: int, augment: bool, generator: torch.Generator
                  ) -> tuple[torch.Tensor, torch.Tensor]:
    """Return ``(o, d)`` of about `count` rays towards the light, on which transmittance is learned.

    With augmentation (the paper's "AG") half of them are random chords, and half leave shading points in
    random directions. Without, they all are camera rays, backwards, through shading points. Shading points lie along
    camera rays where free flight ends, as the renderer's do.
    """
    subset = rays[torch.randint(len(rays), (count // 2 if augment else count,), generator=generator)]
    m, h = chords(subset.o, subset.d)
    toward = -subset.d
    profile = marched.march(m, toward, h, STEPS)
    meets = profile[:, 0] > 0.05
    m, h, toward, profile = (v[meets] for v in (m, h, toward, profile))
    x = m + free_flight(profile, h, 1, generator) * toward
    if not augment:
        return x, toward
    o, d = random_chords(count - len(x), marched.reach, generator)
    return torch.cat([o, x]), torch.cat([d, uniform_directions(len(x), generator)])


def transmittance_color(networks: Networks, marched: TransmittanceTargets, image: Image, rays: Rays, exposure: float,
                        count: int, gain: torch.Tensor | float = 1.0) -> torch.Tensor:
    """Return ‖I_nt − I‖² of the first `count` rays.

    I_nt are pixels lit by τ_nt instead of the marched light, times `gain` (count, 3).
    """
    near = (image.shaded < count).nonzero()[:, 0]
    ray, x = image.shaded[near], image.x[near]
    o, toward = rays.o[:count], -rays.d[:count]
    m, h = chords(o, toward)
    _, mix = networks.ray_mixture(o, toward, marched.march(m, toward, h, STEPS))
    lit = tau(mix[ray], (x * toward[ray]).sum(1, keepdim=True))
    pixel = scatter_sum(image.weight[near, None].detach() * lit * image.radiance[near].detach(), ray, count)
    bounced = image.bounced[:count].detach() if isinstance(image.bounced, torch.Tensor) else 0.0
    return color(gain * (pixel + bounced), rays.target[:count, :3], exposure)
