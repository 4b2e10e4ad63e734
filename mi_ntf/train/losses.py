"""What is minimised (method.md, section 5). Every term is a mean over rays, samples or points, a 0-d tensor."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ..core import mixture, spheres
from ..core.architecture import MAX_LOG_DENSITY
from . import ops
from .networks import Networks, crossings
from .normal_targets import NormalTargets
from .occupancy import LOG_EMPTY
from .rays import Rays
from .transmittance_targets import TransmittanceTargets, chords, random_chords, uniform_directions
from .volume import Image, scatter_sum

DARK = 0.05
"""Brightness, in units of the photographs' bright parts, below which differences count absolutely."""


def color(predicted: torch.Tensor, target: torch.Tensor, exposure: float,
          trust: torch.Tensor | float = 1.0) -> torch.Tensor:
    """(p − t)²/(p + DARK) of exposed linear RGB: the squared error after a square-root tone curve, to first order.

    The denominator is detached, so the minimum is the mean of noisy targets (Mildenhall et al. 2022, eq. 4). `trust`
    (n, 3): what each channel counts.
    """
    p, t = predicted * exposure, target * exposure
    return (trust * (p - t) ** 2 / (p.detach() + DARK)).mean()


def normals(image: Image, d: torch.Tensor, baked: NormalTargets):
    """``(toward, facing)``: distance to the density's own normals; normals that point away from the camera
    (Verbin et al. 2022, eqs. 10, 11). `d` (n, 3): the rays. Weights are detached: normals do not thin the matter."""
    w = image.weight.detach()
    expected, certain = baked.normals(image.x)
    count = len(d)
    toward = (w * certain * (1 - (expected * image.normal).sum(1))).sum() / count
    away = (image.normal * d[image.shaded]).sum(1).clamp(min=0)
    return toward, (w * away**2).sum() / count


ROUGH = 60.0
"""How much dearer the roughest lobe is than a sharp one."""
FAINT = -5.0
"""ln of the specular weight below which it is held: further down its sigmoid has no slope, and there is no way back."""


def gloss(image: Image, least: float, fading: float, count: int) -> torch.Tensor:
    """The specular weight s above the `least` that it can be, the dearer the rougher: (`fading` + ROUGH α⁴) s per ray,
    α = roughness². What α = 1 adds under a flash, a diffuse lobe of a quarter of its weight adds as well, and only that
    is right under other lights. What sharp lobes add nothing else can, so their cost may fade in the course of the
    training. Weights that vanish cost as well: (FAINT − ln s)²/10."""
    roughness, specular = image.gloss
    specular = (specular - least) / (1 - least)
    lost = torch.relu(FAINT - specular.clamp(min=1e-30).log()).square()
    return (image.weight.detach() * (specular * (fading + ROUGH * roughness**8) + 0.1 * lost)).sum() / count


def evenness(networks: Networks, image: Image, over: float, count: int, generator: torch.Generator) -> torch.Tensor:
    """Squared change of ln σ along the surface, in random directions perpendicular to the (detached) predicted normals.

    Photographs with the light at the camera hardly see small bumps of the density, since nothing is in shadow there;
    lit from elsewhere the bumps shade each other and show as blotches. Differences over a quarter of `over` to all of
    it, at `count` samples.
    """
    seen = (image.weight.detach() > 0.02).nonzero()[:, 0]
    if not len(seen):
        return image.weight.sum() * 0
    pick = seen[torch.randint(len(seen), (count,), generator=generator)]
    normal = image.normal[pick].detach()
    along = F.normalize(torch.linalg.cross(normal, uniform_directions(count, generator)), dim=1)
    offset = along * over * (0.25 + 0.75 * torch.rand(count, 1, generator=generator))
    x = image.x[pick]
    raw = networks.log_density(torch.cat([x + offset, x - offset])).clamp(LOG_EMPTY, MAX_LOG_DENSITY)
    return (raw[:count] - raw[count:]).square().mean()


def emptiness(networks: Networks, x: torch.Tensor) -> torch.Tensor:
    """Hinge on ln σ at points `x` that must be empty: pushes under a third of LOG_EMPTY's σ, with no gradient below."""
    return F.relu(networks.log_density(x) - (LOG_EMPTY - 1)).mean()


def total_variation(networks: Networks) -> torch.Tensor:
    """Mean squared difference of neighbouring texels of the field's planes, per texel width of 1/128."""
    terms = []
    for name, p in networks.tensors.items():
        if ".planes." in name and not name.startswith("transmittance"):
            scale = (p.shape[1] / 128) ** 2
            down, across = p[:, 1:] - p[:, :-1], p[:, :, 1:] - p[:, :, :-1]
            terms.append(scale * (down.square().mean() + across.square().mean()))
    return torch.stack(terms).sum()


STEPS = 640
"""Steps of the marches that transmittance is learned from: skins are 0.005 wide, and the shape of the light's decay
inside them decides how bright the surface is (with 256 steps relit images were 3 % too dark)."""


def tau(mix: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """τ (n, k) at places `t` (n, k) of the rays' mixtures (n, K, 3)."""
    return mixture.transmittance(ops, t, tuple(part[:, :, None].unbind(1) for part in mix.unbind(1)))


@dataclass(frozen=True)
class Targets:
    """Rays through `o` (n, 3) along `d` towards the light, their marched profiles `depth` (n, STEPS + 1), and what is
    to be learned: τ = `tau` (n, 33) at the places `t` (n, 33), without gradient.

    16 places of each ray are uniform, and 16 lie where free flight from the light would end: lit surfaces are seen
    there, and a fit that is right on average over the chord is dark in the first half of the skin. The last is `o`.
    """

    o: torch.Tensor
    d: torch.Tensor
    depth: torch.Tensor
    t: torch.Tensor
    tau: torch.Tensor

    def error(self, found: torch.Tensor) -> torch.Tensor:
        """Σ (τ_nrf − τ_nt)² (method.md, section 5): squared errors of `found` (n, 33), means of the three kinds."""
        error = (found - self.tau) ** 2
        return error[:, :16].mean() + error[:, 16:32].mean() + error[:, 32].mean()


def targets(marched: TransmittanceTargets, o: torch.Tensor, d: torch.Tensor, generator: torch.Generator) -> Targets:
    """March the rays through the baked density."""
    m, h = chords(o, d)
    depth = marched.march(m, d, h, STEPS)
    t = (2 * torch.rand(len(o), 16, generator=generator) - 1) * h[:, None]
    lost = torch.rand(len(o), 16, generator=generator) * -torch.expm1(-depth[:, :1])
    own = spheres.coordinate(o.unbind(1), d.unbind(1))
    t = torch.cat([t, crossings(depth, h, -torch.log1p(-lost)), own[:, None]], 1)
    place = ((t / h[:, None] + 1) * (STEPS / 2)).clamp(0, STEPS - 1e-3)
    lower = place.floor().long()
    share = place - lower
    reached = depth.gather(1, lower) * (1 - share) + depth.gather(1, lower + 1) * share
    return Targets(o, d, depth, t, torch.exp(-reached))


def transmittance(networks: Networks, rays: Targets) -> torch.Tensor:
    """The error of the transmittance network; that of rays which miss the sphere counts nothing."""
    hit, mix = networks.ray_mixture(rays.o, rays.d, rays.depth)
    return rays.error(torch.where(hit[:, None], tau(mix, rays.t), rays.tau))


def visibility(networks: Networks, rays: Targets) -> torch.Tensor:
    """The error of the baseline's network, which is asked at every place alone."""
    along = rays.t - (rays.o * rays.d).sum(1, keepdim=True)
    x = rays.o[:, None] + along[:, :, None] * rays.d[:, None]
    found = networks.visibility(x.reshape(-1, 3), rays.d.repeat_interleave(rays.t.shape[1], 0))
    return rays.error(found.view(rays.t.shape))


def training_rays(marched: TransmittanceTargets, rays: Rays, count: int, augment: bool, generator: torch.Generator):
    """``(o, d)`` of about `count` rays to learn transmittance on, towards the light.

    With augmentation (method.md, section 5, "AG") a half are random chords and a half leave shading points in random
    directions; without, all are camera rays, backwards, through shading points. Shading points lie along camera rays
    where free flight ends, as the renderer's do.
    """
    some = rays[torch.randint(len(rays), (count // 2 if augment else count,), generator=generator)]
    m, h = chords(some.o, some.d)
    toward = -some.d
    profile = marched.march(m, toward, h, STEPS)
    meets = profile[:, 0] > 0.05
    m, h, toward, profile = (v[meets] for v in (m, h, toward, profile))
    lost = torch.rand(len(m), 1, generator=generator) * -torch.expm1(-profile[:, :1])
    x = m + crossings(profile, h, -torch.log1p(-lost)) * toward
    if not augment:
        return x, toward
    o, d = random_chords(count - len(x), marched.reach, generator)
    return torch.cat([o, x]), torch.cat([d, uniform_directions(len(x), generator)])


def transmittance_color(networks: Networks, marched: TransmittanceTargets, image: Image, rays: Rays, exposure: float,
                        count: int, gain: torch.Tensor | float = 1.0) -> torch.Tensor:
    """‖I_nt − I‖² of the first `count` rays: pixels lit by τ_nt instead of the marched light (method.md, section 5),
    times `gain` (count, 3)."""
    near = (image.shaded < count).nonzero()[:, 0]
    ray, x = image.shaded[near], image.x[near]
    o, toward = rays.o[:count], -rays.d[:count]
    m, h = chords(o, toward)
    _, mix = networks.ray_mixture(o, toward, marched.march(m, toward, h, STEPS))
    lit = tau(mix[ray], (x * toward[ray]).sum(1, keepdim=True))
    pixel = scatter_sum(image.weight[near, None].detach() * lit * image.radiance[near].detach(), ray, count)
    other = image.bounced[:count].detach() if torch.is_tensor(image.bounced) else 0.0
    return color(gain * (pixel + other), rays.target[:count, :3], exposure)
