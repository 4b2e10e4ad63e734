"""Learned reflectance of a metal sphere of known shape: a coloured lobe, not a diffuse surface in its place."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from mi_ntf.core import microfacet
from mi_ntf.core.architecture import Encoding, Network
from mi_ntf.train import losses, networks, ops, volume
from mi_ntf.train.config import configured

COPPER = (0.955, 0.638, 0.538)
STEPS = 400


def flash_of(cos: torch.Tensor, albedo, specular, roughness: float, tail=None) -> torch.Tensor:
    """Return the radiance (n, 3) of a surface whose light is at the camera, for light of intensity 1 at distance 1."""
    diffuse, gloss = microfacet.lobes_collocated(ops, cos, torch.full_like(cos, roughness), tail)
    return diffuse[:, None] * torch.tensor(albedo) + gloss[:, None] * torch.tensor(specular)


def learned(albedo, specular, roughness: float, tail=None) -> tuple[networks.Reflectance, float]:
    """Return the reflectance and the tail that flash photographs of a sphere teach by the losses of ``fast``."""
    config = configured("fast")
    arch = config.architecture
    generator = torch.Generator().manual_seed(0)
    small = Network(Encoding("planes", (8,), 4), (16,))
    fresh = networks.initial(type(arch)(small, small, arch.transmittance, fresnel=arch.fresnel, retro=arch.retro,
                                        tail=arch.tail, specular_channels=arch.specular_channels), 1.0, generator)
    field = {k: v for k, v in fresh.tensors.items() if k.startswith("reflectance")}
    optimizer = torch.optim.Adam(field.values(), lr=0.01, betas=(0.9, 0.99))
    exposure = 1 / float(flash_of(torch.ones(1), albedo, specular, roughness, tail).max())
    for step in range(STEPS):
        normal = F.normalize(torch.randn(500, 3, generator=generator), dim=1)
        view = F.normalize(normal + 1.2 * torch.randn(500, 3, generator=generator), dim=1)
        cos = (normal * view).sum(1)
        seen = cos > 0.1
        normal, view, cos = normal[seen], view[seen], cos[seen]
        now = fresh.reflectance(0.5 * normal)._replace(normal=normal)
        one = torch.ones(len(cos))
        color = 0.5 * volume.shade(now, -view, one, one[:, None].expand(-1, 3), fresh.retro, None,
                                   fresh.tail)
        image = volume.Image(color, one, normal, one.long(), one.long(), one, now, color, one, 0.0)
        fading = config.lr_end ** (step / STEPS)
        loss = losses.color(color, flash_of(cos, albedo, specular, roughness, tail), exposure)
        loss = loss + config.gloss * losses.gloss(image, arch.least_specular, fading, len(cos))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return fresh.reflectance(0.5 * normal), float(fresh.tail)


@pytest.mark.parametrize(("distribution", "tail"), [("GGX", None), ("Beckmann", 0.0)])
def test_copper_has_a_coloured_lobe_of_the_right_shape(distribution, tail):
    found, its_tail = learned((0.0, 0.0, 0.0), COPPER, 0.5, tail)
    specular = found.specular.mean(0)
    ratio = (specular / specular[0]).numpy()
    np.testing.assert_allclose(ratio, np.array(COPPER) / COPPER[0], rtol=0.05)
    assert specular[0] > 0.8 and float(((1 - found.specular) * found.albedo).mean()) < 0.05
    assert float(found.roughness.mean()) == pytest.approx(0.5, abs=0.03)
    assert its_tail > 0.8 if distribution == "GGX" else its_tail < 0.25


def test_a_diffuse_surface_keeps_its_albedo_and_has_no_lobe():
    found, _ = learned((0.7, 0.45, 0.3), (0.0, 0.0, 0.0), 0.5)
    assert float(found.specular.max()) < 0.08
    np.testing.assert_allclose(found.albedo.mean(0), (0.7, 0.45, 0.3), rtol=0.06)
