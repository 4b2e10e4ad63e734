"""Light of a flash that is not at the lens: its position, its shadows, and the light that points scatter.

Let c_o and c_i be the cosines of viewer and light to the normal. Skins are flat and thin compared with objects that
throw shadows, so a cell at the optical depth D from the camera has the depth D c_o/c_i from the light. The whole skin,
with the phase function ρ (c_i + c_o) of the field, scatters

    L = Σ_j (e^{−(1 + c_o/c_i) D_j} − e^{−(1 + c_o/c_i) D_{j+1}}) V ρ c_i I/d²

with V the fraction of the flash's light that reaches the skin from outside. Of opaque objects V is one march per ray,
from above the mean point that the ray sees. With flash and lens in one place c_o = c_i and V is 1, which
:mod:`mi_ntf.train.volume` computes directly. Smoke has no skin: each of its points is marched to.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from ..core import fresnel, henyey_greenstein, microfacet
from . import ops
from .networks import Reflectance
from .normal_targets import fetch
from .optical import Optical
from .rays import Photographs
from .transmittance_targets import TransmittanceTargets, walk

LEAST_COSINE = 0.03
"""Least cosine of incidence; grazing light crosses as much of the skin as at this cosine."""
DARK = 6.0
"""Optical depth at which marched light counts as absorbed."""
LIFTS = (0.015, 0.025, 0.04, 0.06)
"""Heights above the skin, in radii of the unit sphere, at which shadow rays may begin: at the first one outside of
matter. Early skins are thick, and coarse voxels make all of them so."""
CLEAR = 1.0
"""Density σ below which a place is outside of matter."""


class Flash:
    """Lights of the `photographs`, split after split, in field coordinates.

    `solid` is true if the object has a skin; `marched` is the density that throws shadows, once it is known.
    """

    def __init__(self, photographs: Sequence[Photographs], solid: bool, marched: TransmittanceTargets):
        self.camera = torch.cat([p.origin for p in photographs]).float()  # Lenses (views, 3)
        self.rotation = torch.cat([p.rotation for p in photographs]).float()  # Axes of the cameras (views, 3, 3)
        self.place = torch.cat([p.flash for p in photographs]).float()  # Positions of the lights (views, 3)
        self.solid, self.marched = solid, marched

    def places(self, offset: torch.Tensor) -> torch.Tensor:
        """Return the positions (views, 3) of lights at `offset` (3,) from their lenses: right, up, forward."""
        return self.camera + self.rotation @ (offset * torch.tensor([1.0, 1.0, -1.0]))

    def move(self, offset: torch.Tensor) -> None:
        """Put every light at `offset` from its lens, see :meth:`places`."""
        self.place = self.places(offset)

    def toward(self, view: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return direction (n, 3) and distance (n, 1) from `x` (n, 3) to the lights of photographs `view` (n,)."""
        path = self.place[view] - x
        distance = path.norm(dim=1, keepdim=True)
        return path / distance, distance

    @torch.no_grad()
    def reaching(self, view: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Return the fraction (n,) of the light of photographs `view` (n,) that arrives at `x` (n, 3)."""
        if not self.marched.known:
            return torch.ones(len(x))
        direction, distance = self.toward(view, x)
        _, depth = walk(self.marched, x, direction, DARK, distance[:, 0])
        return torch.exp(-depth)

    def send(self, optical: Optical, reflectance: Reflectance, d: torch.Tensor, x: torch.Tensor, view: torch.Tensor,
             light: torch.Tensor, retro: torch.Tensor | None, phase: float | None = None,
             tail: torch.Tensor | None = None) -> torch.Tensor:
        """Return the radiance (n, 3) that samples at `x` (n, 3) of rays along `d` send to the camera.

        `optical` are the samples' optical depths, `light` (n, 3) radiant intensities. `retro` is the
        retro-reflection, None without a Fresnel term. `phase` is the asymmetry of smoke, `tail` that of the specular
        lobe. Shadows on skins are left out, see :meth:`lit`.
        """
        normal, albedo, roughness, specular = reflectance
        toward, distance = self.toward(view, x)
        if phase is not None:
            weight = torch.exp(-optical.front) * -torch.expm1(-optical.depth) * self.reaching(view, x)
            scattered = henyey_greenstein.phase(ops, phase, (toward * d).sum(1))
            smoke: torch.Tensor = (weight * scattered)[:, None] * albedo * light / distance**2
            return smoke
        wi, wo, n = toward.unbind(1), (-d).unbind(1), normal.unbind(1)
        diffuse_weight, gloss_weight = fresnel.weights(ops, wi, wo, n, roughness, specular.T, retro)
        if self.solid:
            diffuse, glossy = microfacet.lobes(ops, wi, wo, n, roughness, tail)
            with torch.no_grad():
                cos_i, cos_o = ((normal * v).sum(1).clamp(min=LEAST_COSINE) for v in (toward, -d))
                ratio = 1 + cos_o / cos_i
            faces = (normal.detach() * d).sum(1) < 0
            weight = torch.exp(-ratio * optical.front) * -torch.expm1(-ratio * optical.depth) * faces
        else:
            diffuse, glossy = microfacet.scattering(ops, wi, wo, n, roughness, tail=tail)
            weight = torch.exp(-optical.front) * -torch.expm1(-optical.depth) * self.reaching(view, x)
        lobe: torch.Tensor = (diffuse_weight * diffuse).T * albedo + (gloss_weight * glossy).T
        return weight[:, None] * lobe * light / distance**2

    @torch.no_grad()
    def lit(self, view: torch.Tensor, x: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
        """Return V (n,), the fraction of light that reaches opaque skins at `x` (n, 3) with mean `normal` (n, 3)."""
        if not self.solid or not self.marched.known:
            return torch.ones(len(x))
        return self.reaching(view, above(self.marched, x, F.normalize(normal, dim=1)))


def above(marched: TransmittanceTargets, x: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Return origins (n, 3) of shadow rays for points of skin at `x` (n, 3) with unit `normal` (n, 3)."""
    places = x + torch.tensor(LIFTS)[:, None, None] * normal
    sigma = fetch(marched.log_sigma, places.reshape(-1, 3))[0].view(len(LIFTS), -1).exp()
    inside = (sigma > CLEAR).to(torch.uint8)
    first = inside.cumprod(0).sum(0).clamp(max=len(LIFTS) - 1).long()
    return places[first, torch.arange(len(x))]
