"""Light of a flash that is not at the lens: where it comes from, what of it is in the shadow, what points send on.

A cell of the camera's ray at the optical depth D from the camera is D c_o/c_i deep for light that falls in at the
cosine c_i to the normal, where the viewer's is c_o: skins are flat and thin beside what throws shadows. So what the
field's phase function ρ (c_i + c_o) sends back from the whole skin is

    L = Σ_j (e^{−(1 + c_o/c_i) D_j} − e^{−(1 + c_o/c_i) D_{j+1}}) V ρ c_i I/d²

with V the share of the flash's light that reaches the skin from outside, of opaque things that of one march a ray, from
above the mean point that the ray sees. With flash and lens in one place c_o = c_i and V is 1:
:mod:`mi_ntf.train.volume` has that case without all this. Smoke has no skin: its points are marched to themselves, each
of them.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from ..core import fresnel, microfacet
from . import ops
from .normal_targets import fetch
from .optical import Optical
from .rays import Photographs
from .transmittance_targets import TransmittanceTargets, walk

LEAST_COSINE = 0.03
"""Light that grazes the skin goes through as much of it as at this cosine."""
DARK = 6.0
"""Optical depth from which on marched light counts as gone."""
LIFTS = (0.015, 0.025, 0.04, 0.06)
"""Heights above the skin, in radii of the unit sphere, at the first of which that is out of matter shadow rays begin:
early skins are thick, and coarse voxels make all of them so."""
CLEAR = 1.0
"""σ under which a place is out of matter."""


class Flash:
    """The lights of all photographs, the splits' one after the other.

    `camera`, `rotation`: the cameras (views, 3) and their axes (views, 3, 3) · `place` (views, 3): the lights, field
    coordinates · `marched`: the density that throws shadows; none before it is known.
    """

    def __init__(self, photographs: Sequence[Photographs], solid: bool, marched: TransmittanceTargets):
        self.camera = torch.cat([p.origin for p in photographs]).float()
        self.rotation = torch.cat([p.rotation for p in photographs]).float()
        self.place = torch.cat([p.flash for p in photographs]).float()
        self.solid, self.marched = solid, marched

    def places(self, offset: torch.Tensor) -> torch.Tensor:
        """Where lights at `offset` (3,) from their lenses are (views, 3): right, up, forward in field lengths."""
        return self.camera + self.rotation @ (offset * torch.tensor([1.0, 1.0, -1.0]))

    def move(self, offset: torch.Tensor) -> None:
        """Put every light at `offset` from its lens, as of :meth:`places`."""
        self.place = self.places(offset)

    def toward(self, view: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``(direction (n, 3), distance (n, 1))`` of the lights of photographs `view` (n,), from `x` (n, 3)."""
        away = self.place[view] - x
        distance = away.norm(dim=1, keepdim=True)
        return away / distance, distance

    @torch.no_grad()
    def reaching(self, view: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Share (n,) of the light of photographs `view` that arrives at `x` (n, 3)."""
        if not self.marched.known:
            return torch.ones(len(x))
        direction, distance = self.toward(view, x)
        _, depth = walk(self.marched, x, direction, DARK, distance[:, 0])
        return torch.exp(-depth)

    def send(self, seen: Optical, reflectance: tuple, d: torch.Tensor, x: torch.Tensor, view: torch.Tensor,
             light: torch.Tensor, rim: bool) -> torch.Tensor:
        """Radiance (n, 3) that samples at `x` (n, 3) of rays along `d` send to the camera.

        `seen`: their cells' optical depths · `reflectance`: of :meth:`Networks.reflectance` · `light` (n, 3): as of
        :class:`Rays` · `rim`: whether the field has a Fresnel term.
        """
        normal, albedo, roughness, specular = reflectance
        toward, distance = self.toward(view, x)
        wi, wo, n = toward.unbind(1), (-d).unbind(1), normal.unbind(1)
        of_diffuse, of_gloss = fresnel.weights(ops, wi, wo, n, roughness, specular, rim)
        if self.solid:
            diffuse, glossy = microfacet.lobes(ops, wi, wo, n, roughness)
            with torch.no_grad():
                cos_i, cos_o = ((normal * v).sum(1).clamp(min=LEAST_COSINE) for v in (toward, -d))
                ratio = 1 + cos_o / cos_i
            faces = (normal.detach() * d).sum(1) < 0
            weight = torch.exp(-ratio * seen.front) * -torch.expm1(-ratio * seen.depth) * faces
        else:
            diffuse, glossy = microfacet.scattering(ops, wi, wo, n, roughness)
            weight = torch.exp(-seen.front) * -torch.expm1(-seen.depth) * self.reaching(view, x)
        lobe = (of_diffuse * diffuse)[:, None] * albedo + (of_gloss * glossy)[:, None]
        return weight[:, None] * lobe * light / distance**2

    @torch.no_grad()
    def lit(self, view: torch.Tensor, x: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
        """V (n,): what reaches opaque skins at `x` (n, 3) of mean `normal` (n, 3), out of their own matter."""
        if not self.solid or not self.marched.known:
            return torch.ones(len(x))
        return self.reaching(view, above(self.marched, x, F.normalize(normal, dim=1)))


def above(marched: TransmittanceTargets, x: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Where shadow rays begin (n, 3) over points of skin at `x` (n, 3) with unit `normal` (n, 3)."""
    places = x + torch.tensor(LIFTS)[:, None, None] * normal
    sigma = fetch(marched.log_sigma, places.reshape(-1, 3))[0].view(len(LIFTS), -1).exp()
    inside = (sigma > CLEAR).to(torch.uint8)
    first = inside.cumprod(0).sum(0).clamp(max=len(LIFTS) - 1).long()
    return places[first, torch.arange(len(x))]
