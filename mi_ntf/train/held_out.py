"""Accuracy of the transmittance network on points and lights that training has not seen."""

import torch

from . import device
from .losses import tau
from .networks import Networks, depth_at, free_flight
from .rays import Photographs
from .transmittance_targets import TransmittanceTargets, chords, uniform_directions

STEPS = 2048
PAIRS = 4096
"""Largest number of pairs of a shading point and a light."""
CHUNK = 512
"""Number of pairs that are evaluated at once."""


@torch.no_grad()
def score(networks: Networks, marched: TransmittanceTargets, photographs: Photographs, fraction: float = 1.0
          ) -> dict[str, float]:
    """Return ``rms`` and ``bias`` of τ_nt against the `marched` τ of the field; empty if no ray sees matter.

    They are taken over a `fraction` of PAIRS pairs of a shading point of the held-out `photographs` and a light in a
    random direction.
    """
    generator, errors = device.generator(4), [torch.zeros(0)]
    for _ in range(0, max(1, round(fraction * PAIRS)), CHUNK):
        rays = photographs[photographs.random(16 * CHUNK, generator)]
        rays = rays[(rays.target[:, 3] > 0.5).nonzero()[:CHUNK, 0]]
        m, h = chords(rays.o, rays.d)
        x = m - free_flight(marched.march(m, -rays.d, h, STEPS), h, 1, generator) * rays.d
        d = uniform_directions(len(rays), generator)
        m, h = chords(x, d)
        profile = marched.march(m, d, h, STEPS)
        t = (x * d).sum(1, keepdim=True)
        hit, mixture = networks.ray_mixture(x, d, profile)
        predicted = torch.where(hit[:, None], tau(mixture, t), 1.0)
        errors.append((predicted - torch.exp(-depth_at(profile, h, t)))[:, 0])
    error = torch.cat(errors)
    if not len(error):
        return {}
    return {"rms": round(float(error.square().mean().sqrt()), 4), "bias": round(float(error.mean()), 4)}
