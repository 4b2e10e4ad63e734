"""Light of the flash that one part of the object throws on another: photographs hold it, and albedo must not.

The radiosity of :mod:`mi_ntf.core.radiosity` between patches of the skin as it has been learned so far, for every
photograph's flash, found anew now and then. What is learned as albedo before the first time is too much by the share of
the bounced light, and every round leaves that share of the rest.
"""

import numpy as np
import torch

from ..core import radiosity
from .flash import Flash
from .networks import Networks
from .rays import Rays
from .transmittance_targets import TransmittanceTargets, walk
from .volume import diffuse_albedo

SEEN = 1 << 16
"""Camera rays that look for the skin; rays from what they find look into its folds."""
SIDE = 8
"""Rays from a patch, squared."""


class Bounced:
    """`table` (6, z, y, x), which patch stands where, `light` (views, patches + 1, 3), irradiance by other patches,
    the last 0, and `open` (patches + 1,), the share of it that other patches leave, the last 1; from :meth:`update`.

    `power` (views, 3): of the flashes, as :class:`Rays`' `light`. `room`, where it is given: ln of what the room sends
    back of a flash, from all sides alike, over what arrives from the flash itself at the sphere's middle (3,).
    """

    def __init__(self, flash: Flash, power: torch.Tensor, room: torch.Tensor | None = None):
        self.flash, self.power, self.room = flash, power, room

    @property
    def known(self) -> bool:
        return hasattr(self, "light")

    def __call__(self, view: torch.Tensor, x: torch.Tensor, normal: torch.Tensor, generator: torch.Generator):
        """Irradiance (n, 3) at the points `x` (n, 3) of photographs `view` (n,), from other patches and the room: of
        one patch near each, drawn so that the mean is what the renderer interpolates."""
        n, cells = len(x), radiosity.CELLS
        u = torch.rand(n, 4, generator=generator)
        squares = normal.detach().square()
        axis = (u[:, 3:] * squares.sum(1, keepdim=True) > squares.cumsum(1)[:, :2]).sum(1)
        face = 2 * axis + (normal.gather(1, axis[:, None])[:, 0] < 0)
        i, j, k = ((x + 1) * (cells / 2) + u[:, :3] - 0.5).long().clamp(0, cells - 1).unbind(1)
        patch = self.table[face, k, j, i]
        if self.room is None:
            return self.light[view, patch]
        arriving = self.power[view] / self.flash.place[view].square().sum(1, keepdim=True)
        return self.light[view, patch] + self.open[patch, None] * arriving * self.room.exp()

    @torch.no_grad()
    def update(self, networks: Networks, marched: TransmittanceTargets, rays: Rays, seed: int) -> None:
        """Find the patches of the field that some SEEN camera `rays` see, what they see of each other, and what of all
        flashes they send on."""
        rng = np.random.default_rng(seed)
        _, x, normal = _skin(networks, marched, rays.o, rays.d)
        kept = radiosity.thin(x, normal)
        _, *folds = _skin(networks, marched, *_rays(x[kept], normal[kept], 3, rng))
        x, normal = (np.concatenate([a[kept], b]) for a, b in zip((x, normal), folds, strict=True))
        kept = radiosity.thin(x, normal)
        x, normal = x[kept], normal[kept]
        table, hits = radiosity.table(x, normal), np.full(len(x) * SIDE**2, -1)
        ray, *there = _skin(networks, marched, *_rays(x, normal, SIDE, rng))
        hits[ray] = table[radiosity.place(*there)]
        # All photographs at once, three columns each.
        views, count = len(self.power), len(x)
        albedo = diffuse_albedo(networks.reflectance(_tensor(x)), networks.fresnel).cpu().numpy()
        direct = self._direct(marched, x, normal).transpose(1, 0, 2).reshape(count, -1)
        light = radiosity.solve(hits.reshape(count, -1), np.tile(albedo, (1, views)), direct, -1)
        light = np.pad(light, [(0, 1), (0, 0)]).reshape(count + 1, views, 3).transpose(1, 0, 2)
        self.table = torch.as_tensor(np.where(table < 0, count, table))
        self.open = _tensor(np.append((hits.reshape(count, -1) < 0).mean(1), 1.0))
        self.light = torch.as_tensor(np.ascontiguousarray(light, np.float32))

    def _direct(self, marched: TransmittanceTargets, x: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(views, patches, 3): irradiance by the flashes alone."""
        outside, upward = _tensor(radiosity.above(x, normal)), _tensor(normal)
        result = torch.zeros(len(self.power), len(x), 3)
        for place, power, lit in zip(self.flash.place, self.power, result, strict=True):
            away = place - outside
            distance = away.norm(dim=1)
            cos = (away * upward).sum(1) / distance
            faces = (cos > 0).nonzero()[:, 0]
            _, depth = walk(marched, outside[faces], (away / distance[:, None])[faces], 6.0)
            lit[faces] = (cos[faces] / distance[faces] ** 2 * torch.exp(-depth))[:, None] * power
        return result.double().cpu().numpy()


def _rays(x: np.ndarray, normal: np.ndarray, side: int, rng: np.random.Generator) -> list[torch.Tensor]:
    """:func:`mi_ntf.core.radiosity.rays` as tensors."""
    return [_tensor(v) for v in radiosity.rays(x, normal, side, rng)]


def _skin(networks: Networks, marched: TransmittanceTargets, o: torch.Tensor, d: torch.Tensor):
    """``(ray, x, normal)``, arrays: which rays meet skin that faces them, where (k, 3), and its normals (k, 3)."""
    t, _ = walk(marched, o, d, radiosity.DEPTH)
    ray = t.isfinite().nonzero()[:, 0]
    x = torch.addcmul(o[ray], d[ray], t[ray, None])
    normal = torch.cat([networks.reflectance(part)[0] for part in x.split(65536)])
    faces = (normal * d[ray]).sum(1) < 0
    return ray[faces].cpu().numpy(), *(v[faces].double().cpu().numpy() for v in (x, normal))


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.ascontiguousarray(values, np.float32))
