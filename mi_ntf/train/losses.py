"""What is minimised (method.md, section 5). Every term is a mean over rays, samples or points, a 0-d tensor."""

import torch
import torch.nn.functional as F

from ..core import logistic, spheres
from ..core.architecture import MAX_LOG_DENSITY
from . import ops
from .baked import Baked, chords, random_chords, uniform_directions
from .networks import Networks
from .occupancy import LOG_EMPTY
from .rays import Rays
from .render import Image, scatter_sum

DARK = 0.05
"""Brightness, in units of the photographs' bright parts, below which differences count absolutely."""


def color(predicted: torch.Tensor, target: torch.Tensor, exposure: float) -> torch.Tensor:
    """(p − t)²/(p + DARK) of exposed linear RGB: the squared error after a square-root tone curve, to first order.

    The denominator is detached, so the minimum is the mean of noisy targets (Mildenhall et al. 2022, eq. 4).
    """
    p, t = predicted * exposure, target * exposure
    return ((p - t) ** 2 / (p.detach() + DARK)).mean()


def normals(image: Image, d: torch.Tensor, baked: Baked):
    """``(toward, facing)``: distance to the density's own normals; normals that point away from the camera
    (Verbin et al. 2022, eqs. 10, 11). `d` (n, 3): the rays. Weights are detached: normals do not thin the matter."""
    w = image.weight.detach()
    expected, certain = baked.normals(image.x)
    count = len(d)
    toward = (w * certain * (1 - (expected * image.normal).sum(1))).sum() / count
    away = (image.normal * d[image.shaded]).sum(1).clamp(min=0)
    return toward, (w * away**2).sum() / count


def evenness(networks: Networks, image: Image, count: int, generator: torch.Generator) -> torch.Tensor:
    """Squared change of ln σ along the surface, in random directions perpendicular to the (detached) predicted normals.

    Photographs with the light at the camera hardly see small bumps of the density, since nothing is in shadow there;
    lit from elsewhere the bumps shade each other and show as blotches. Differences over 0.005 to 0.02 at `count`
    samples.
    """
    seen = (image.weight.detach() > 0.02).nonzero()[:, 0]
    if not len(seen):
        return image.weight.sum() * 0
    pick = seen[torch.randint(len(seen), (count,), generator=generator)]
    normal = image.normal[pick].detach()
    along = F.normalize(torch.linalg.cross(normal, uniform_directions(count, generator)), dim=1)
    offset = along * (0.005 + 0.015 * torch.rand(count, 1, generator=generator))
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


def transmittance(networks: Networks, baked: Baked, surface: torch.Tensor, count: int, generator: torch.Generator,
                  steps: int = 160) -> torch.Tensor:
    """Σ (τ_nrf − τ_nt)² on fresh rays: half of them random (method.md, section 5, AG), half through points of `surface`
    (n, 3) in random directions, where τ at that point counts once more, since shading happens there.

    Targets are marched through the baked density and carry no gradient.
    """
    o, d = random_chords(count, baked.reach, generator)
    if len(surface):
        pick = torch.randint(len(surface), (count // 2,), generator=generator)
        o = torch.cat([o[:count - len(pick)], surface[pick]])
        d = torch.cat([d[:count - len(pick)], uniform_directions(len(pick), generator)])
    m, h = chords(o, d)
    depth = baked.march(m, d, h, steps, generator)
    stride = 4
    first = int(torch.randint(stride, (1,), generator=generator))
    at = torch.arange(first, steps + 1, stride)
    t = (at * (2 / steps) - 1) * h[:, None]
    hit, a, b = networks.transmittance_parameters(o, d)
    t_own = spheres.coordinate(o.unbind(1), d.unbind(1))
    place = ((t_own / h + 1) * (steps / 2)).clamp(0, steps - 1e-3)
    lower = place.floor().long()
    share = place - lower
    own = depth.gather(1, lower[:, None])[:, 0] * (1 - share) + depth.gather(1, lower[:, None] + 1)[:, 0] * share
    along = logistic.transmittance(ops, t, a[:, None], b[:, None]) - torch.exp(-depth[:, at])
    point = logistic.transmittance(ops, t_own, a, b) - torch.exp(-own)
    return (hit[:, None] * along**2).mean() + 0.5 * (hit * point**2).mean()


def transmittance_color(networks: Networks, image: Image, rays: Rays, exposure: float, count: int) -> torch.Tensor:
    """‖I_nt − I‖² of the first `count` rays: pixels lit by τ_nt instead of the marched light (method.md, section 5)."""
    near = (image.shaded < count).nonzero()[:, 0]
    ray, x = image.shaded[near], image.x[near]
    toward = -rays.d[:count]
    _, a, b = networks.transmittance_parameters(rays.o[:count], toward)
    tau = logistic.transmittance(ops, (x * toward[ray]).sum(1), a[ray], b[ray])
    pixel = scatter_sum((image.weight[near].detach() * tau)[:, None] * image.radiance[near].detach(), ray, count)
    return color(pixel, rays.target[:count, :3], exposure)
