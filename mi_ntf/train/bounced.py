"""Light of the flash that one part of the object throws on another. Photographs contain it, and albedo must not.

This is the radiosity of :mod:`mi_ntf.core.radiosity` between patches of the skin as learned so far, for every
photograph's flash. It is computed again a few times during training. Before the first time, the learned albedo is too
large by the fraction of bounced light; each later round reduces the rest by that fraction.
"""

import numpy as np
import torch

from ..core import radiosity
from .flash import Flash
from .networks import Networks, in_parts
from .rays import Rays
from .transmittance_targets import TransmittanceTargets, walk

CAMERA_RAYS = 1 << 16
"""Camera rays that search for the skin; rays from the points that they hit search its folds."""
SIDE = 8
"""Square root of the number of rays from a patch."""


class Bounced:
    """Irradiance of the skin by bounced light of all photographs' flashes, of radiant intensity `power` (views, 3).

    `room` is the logarithm (3,) of the light that the room reflects from all sides; None means a dark room. It is
    relative to the light that arrives from the flash at the centre of the sphere.
    """

    def __init__(self, flash: Flash, power: torch.Tensor, room: torch.Tensor | None = None):
        self.flash, self.power, self.room = flash, power, room
        self.table = torch.zeros(0, dtype=torch.long)
        """Index of the patch that is used in each cell of a grid (6, z, y, x)."""
        self.light = torch.zeros(0)  # Irradiance by other patches (views, patches + 1, 3), the last one 0
        self.open = torch.zeros(0)
        """Fraction of the sky of each patch that other patches leave open (patches + 1,), the last one 1."""

    @property
    def known(self) -> bool:
        """True after the first :meth:`update`."""
        return self.light.numel() > 0

    def state(self) -> dict[str, torch.Tensor]:
        """Return the tensors that change during training."""
        return {"table": self.table, "light": self.light, "open": self.open}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Restore a :meth:`state`."""
        self.table, self.light, self.open = state["table"], state["light"], state["open"]

    def __call__(self, view: torch.Tensor, x: torch.Tensor, normal: torch.Tensor, generator: torch.Generator | None
                 ) -> torch.Tensor:
        """Return the irradiance (n, 3) by other patches and the room at points `x` (n, 3) of photographs `view` (n,).

        It is that of one nearby patch for each point, sampled so that the mean is what the renderer interpolates.
        """
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
        """Find the patches that camera `rays` see and solve for the light that they exchange under each flash."""
        rng = np.random.default_rng(seed)
        _, x, normal = _skin(networks, marched, rays.o, rays.d)
        patches = radiosity.thin(x, normal)
        _, *folds = _skin(networks, marched, *_rays(x[patches], normal[patches], 3, rng))
        x, normal = (np.concatenate([a[patches], b]) for a, b in zip((x, normal), folds, strict=True))
        patches = radiosity.thin(x, normal)
        x, normal = x[patches], normal[patches]
        table, hits = radiosity.table(x, normal), np.full(len(x) * SIDE**2, -1)
        ray, hit_x, hit_normal = _skin(networks, marched, *_rays(x, normal, SIDE, rng))
        hits[ray] = table[radiosity.place(hit_x, hit_normal)]
        # All photographs at once, three columns each.
        views, count = len(self.power), len(x)
        albedo = networks.reflectance(_tensor(x)).diffuse_albedo(networks.fresnel).cpu().numpy()
        direct = self._direct(marched, x, normal).transpose(1, 0, 2).reshape(count, 3 * views)
        by_patch = hits.reshape(count, SIDE**2)
        light = radiosity.solve(by_patch, np.tile(albedo, (1, views)), direct, -1)
        light = np.pad(light, [(0, 1), (0, 0)]).reshape(count + 1, views, 3).transpose(1, 0, 2)
        self.table = torch.as_tensor(np.where(table < 0, count, table))
        self.open = _tensor(np.append((by_patch < 0).mean(1), 1.0))
        self.light = torch.as_tensor(np.ascontiguousarray(light, np.float32))

    def _direct(self, marched: TransmittanceTargets, x: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Return the irradiance (views, patches, 3) by the flashes alone."""
        outside, upward = _tensor(radiosity.above(x, normal)), _tensor(normal)
        result = torch.zeros(len(self.power), len(x), 3)
        for place, power, lit in zip(self.flash.place, self.power, result, strict=True):
            path = place - outside
            distance = path.norm(dim=1)
            cos = (path * upward).sum(1) / distance
            faces = (cos > 0).nonzero()[:, 0]
            _, depth = walk(marched, outside[faces], (path / distance[:, None])[faces], 6.0)
            lit[faces] = (cos[faces] / distance[faces] ** 2 * torch.exp(-depth))[:, None] * power
        return result.double().cpu().numpy()


def _rays(x: np.ndarray, normal: np.ndarray, side: int, rng: np.random.Generator
          ) -> tuple[torch.Tensor, torch.Tensor]:
    """Return :func:`mi_ntf.core.radiosity.rays` as tensors, origins and directions."""
    o, d = radiosity.rays(x, normal, side, rng)
    return _tensor(o), _tensor(d)


def _skin(networks: Networks, marched: TransmittanceTargets, o: torch.Tensor, d: torch.Tensor
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which rays (k,) hit skin that faces them, the hit points (k, 3) and the normals there (k, 3)."""
    t, _ = walk(marched, o, d, radiosity.DEPTH)
    ray = t.isfinite().nonzero()[:, 0]
    x = torch.addcmul(o[ray], d[ray], t[ray, None])
    normal = in_parts(lambda part: networks.reflectance(part)[0], x)
    faces = (normal * d[ray]).sum(1) < 0
    return (ray[faces].cpu().numpy(), x[faces].double().cpu().numpy(), normal[faces].double().cpu().numpy())


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.ascontiguousarray(values, np.float32))
