"""How well the transmittance network knows the field: on points and lights that no training has seen."""

import torch

from . import device
from .losses import tau
from .networks import Networks, crossings
from .occupancy import Occupancy
from .rays import Photographs
from .transmittance_targets import TransmittanceTargets, chords, uniform_directions

STEPS = 2048


@torch.no_grad()
def score(networks: Networks, occupancy: Occupancy, photographs: Photographs, count: int = 4096,
          chunk: int = 512) -> dict[str, float]:
    """``rms`` and ``bias`` of τ_nt against the field's own marched τ, on about `count` pairs of a shading point of the
    (held-out) `photographs` and a light in a random direction; `occupancy`: of
    :func:`mi_ntf.train.scoring.occupied`. Empty where no ray sees matter."""
    generator = device.generator(4)
    marched = TransmittanceTargets()
    marched.update(networks, occupancy)
    errors = [torch.zeros(0)]
    for _ in range(0, count, chunk):
        some = photographs[photographs.random(16 * chunk, generator)]
        some = some[(some.target[:, 3] > 0.5).nonzero()[:chunk, 0]]
        m, h = chords(some.o, some.d)
        profile = marched.march(m, -some.d, h, STEPS)
        lost = torch.rand(len(some), 1, generator=generator) * -torch.expm1(-profile[:, :1])
        x = m - crossings(profile, h, -torch.log1p(-lost)) * some.d
        d = uniform_directions(len(some), generator)
        m, h = chords(x, d)
        profile = marched.march(m, d, h, STEPS)
        t = (x * d).sum(1, keepdim=True)
        place = ((t / h[:, None] + 1) * (STEPS / 2)).clamp(0, STEPS - 1e-3)
        lower = place.floor().long()
        depth = torch.lerp(profile.gather(1, lower), profile.gather(1, lower + 1), place - lower)
        hit, mixture = networks.ray_mixture(x, d, profile)
        found = torch.where(hit[:, None], tau(mixture, t), 1.0)
        errors.append((found - torch.exp(-depth))[:, 0])
    error = torch.cat(errors)
    if not len(error):
        return {}
    return {"rms": round(float(error.square().mean().sqrt()), 4), "bias": round(float(error.mean()), 4)}
