"""Coarse grid of densities, so that samples are spent at the visible surface alone."""

from dataclasses import replace

import torch
import torch.nn.functional as F

from .networks import Networks, in_parts
from .rays import Rays, cell_centers

FULL_BELOW = 0.3
"""Density σ (1/radius) below which a cell counts as empty: a whole cell takes less than 1 % of the light."""
LOG_EMPTY = -4.0
"""ln σ that counts as empty: a fifth of the density at which the renderer cuts (σ = 0.1)."""
HAZE = 0.1
"""Density σ (1/radius) below which a cell of smoke counts as empty. The renderer leaves out lower densities, too."""
STRAY_SAMPLES = 1 << 18
"""Cells outside the hull that an update samples, besides those in which the last one found matter."""
OPAQUE_DEPTH = 10.0
"""Optical depth behind which no samples are placed: their light is attenuated by e^−10 twice."""


class Occupancy:
    """Densities of [−1, 1]³ on cells³ cells, [x, y, z]; `hull` (bool) bounds where matter may be.

    Cells below the density `empty` are empty.
    """

    def __init__(self, hull: torch.Tensor, empty: float = FULL_BELOW):
        self.cells, self.empty = hull.shape[0], empty
        self.index = hull.reshape(-1).nonzero()[:, 0]  # Flat indices of the cells in the hull
        self.sigma = torch.full((self.cells**3,), -1.0)  # Density of each cell, −1 if it is empty
        self.sigma[self.index] = 0.0
        self.level = torch.zeros(len(self.index))
        """Slowly fading maximum of the densities that were sampled in each cell of the hull."""
        self.outside = (~hull).reshape(-1).nonzero()[:, 0]  # Flat indices of the cells outside the hull
        self.stray = self.outside[:0]  # Cells outside the hull where the networks still put matter

    def state(self) -> dict[str, torch.Tensor]:
        """Return the tensors that change during training."""
        return {"sigma": self.sigma, "level": self.level, "stray": self.stray}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Restore a :meth:`state`."""
        self.sigma, self.level, self.stray = state["sigma"], state["level"], state["stray"]

    def positions(self, index: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return one random point (n, 3) in each of the cells `index` (n,)."""
        n = self.cells
        corner = torch.stack([index // (n * n), index // n % n, index % n], 1)
        return (corner + torch.rand(corner.shape, generator=generator)) * (2 / n) - 1

    @torch.no_grad()
    def sample(self, networks: Networks, generator: torch.Generator, decay: float = 1.0) -> torch.Tensor:
        """Return the density at a random point of every cell of the hull, and raise the cell's level to it."""
        sigma = networks.density(self.positions(self.index, generator))
        self.level = torch.maximum(self.level * decay, sigma)
        return sigma

    @torch.no_grad()
    def update(self, networks: Networks, generator: torch.Generator) -> None:
        """Sample all cells again. Old levels fade slowly, so that a thin skin is not lost."""
        n = self.cells
        sampled = self.sample(networks, generator, 0.8)
        grid = torch.zeros(n**3)
        grid[self.index] = (self.level > self.empty).float()
        near = neighbour_maximum(grid.view(n, n, n)).reshape(-1)[self.index] > 0
        # A cell takes as much light as its thinnest neighbour would: skins, which fill cells in part, hide nothing.
        grid[self.index] = sampled
        least = -neighbour_maximum(-grid.view(n, n, n)).reshape(-1)[self.index]
        self.sigma[self.index] = torch.where(near, least, -1.0)
        pick = torch.randint(max(len(self.outside), 1), (min(len(self.outside), STRAY_SAMPLES),), generator=generator)
        candidates = torch.unique(torch.cat([self.stray, self.outside[pick]]))
        matter = in_parts(networks.log_density, self.positions(candidates, generator)) > LOG_EMPTY
        self.stray = candidates[matter]

    def must_be_empty(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return points (≤ 2·count, 3) outside the hull: half anywhere, half in cells where matter has strayed."""
        cells = [c[torch.randint(len(c), (count,), generator=generator)] for c in (self.outside, self.stray) if len(c)]
        return self.positions(torch.cat(cells), generator) if cells else torch.zeros(0, 3)

    def lookup(self, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """Return σ of the cells that hold the points; −1 marks an empty cell."""
        n = self.cells
        i, j, k = (((c + 1) * (n / 2)).int().clamp(0, n - 1) for c in (x, y, z))
        return self.sigma[(i * n + j) * n + k]

    def tighten(self, rays: Rays) -> tuple[torch.Tensor, Rays]:
        """Apply the :class:`Spans` of the occupied cells to `rays`."""
        n = self.cells
        return Spans((self.sigma >= 0).view(n, n, n))(rays)

    @torch.no_grad()
    def visible(self, rays: Rays, step: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the occupied, visible cells of length `step` along the rays, packed ``(ray, near)``.

        They are ordered along each ray; `near` is the distance of a cell's near end. Each ray is shifted at random, so
        that the bounds of its cells vary.
        """
        count = max(1, int(((rays.t1 - rays.t0).max() / step).ceil()))
        near = torch.arange(count) + torch.rand(len(rays), 1, generator=generator) - 0.5
        t = rays.t0[:, None] + (near + torch.rand(len(rays), count, generator=generator)) * step
        o, d = rays.o, rays.d
        sigma = self.lookup(*torch.addcmul(o.T[:, :, None], t[None], d.T[:, :, None]))
        depth = (sigma.clamp(min=0) * step).cumsum(1)
        ahead = depth - sigma.clamp(min=0) * step < OPAQUE_DEPTH
        ray, k = torch.nonzero((sigma >= 0) & ahead & (t < rays.t1[:, None]) & (t > rays.t0[:, None]), as_tuple=True)
        return ray, (rays.t0[:, None] + near * step)[ray, k]


class Spans:
    """Pieces of rays that meet a cell of `full` (n, n, n) bool, [x, y, z], which covers [−1, 1]³.

    Two passes, blocks of 4³ cells (and their neighbours), then cells: most rays leave early.
    """

    BLOCK = 4

    def __init__(self, full: torch.Tensor):
        n = full.shape[0]
        self.full = full
        padded = F.pad(full.float()[None, None], (0, -n % self.BLOCK) * 3)
        self.coarse = F.max_pool3d(F.max_pool3d(padded, self.BLOCK), 3, 1, 1)[0, 0] > 0

    @torch.no_grad()
    def __call__(self, rays: Rays, chunk: int = 32768) -> tuple[torch.Tensor, Rays]:
        """Return the indices of the rays that meet a full cell, and these rays with `t0`, `t1` around the cells."""
        n, edge = self.full.shape[0], self.BLOCK * self.coarse.shape[0]
        extent = 2 * edge / n  # blocks may stick out of [−1, 1]³
        index, rays = _spans(rays, self.coarse, extent, 2 * self.BLOCK / n, chunk)
        fine, rays = _spans(rays, self.full, 2.0, 1 / n, chunk)
        return index[fine], rays

    def points(self) -> torch.Tensor:
        """Return the centres (k, 3) of the blocks that hold full cells or are beside one that does."""
        width = 2 * self.BLOCK / self.full.shape[0]
        return (self.coarse.nonzero() + 0.5) * width - 1


def neighbour_maximum(grid: torch.Tensor) -> torch.Tensor:
    """Return the maximum of each value of a grid (k, k, k) and its 26 neighbours.

    It goes axis by axis, in a fifth of the time of ``max_pool3d``.
    """
    for axis in range(3):
        n = grid.shape[axis]
        result = grid.clone()
        torch.maximum(result.narrow(axis, 0, n - 1), grid.narrow(axis, 1, n - 1), out=result.narrow(axis, 0, n - 1))
        torch.maximum(result.narrow(axis, 1, n - 1), grid.narrow(axis, 0, n - 1), out=result.narrow(axis, 1, n - 1))
        grid = result
    return grid


def _spans(rays: Rays, full: torch.Tensor, extent: float, step: float, chunk: int) -> tuple[torch.Tensor, Rays]:
    """Return the indices of the rays that meet a cell of `full` (k, k, k) in steps of `step`, and them with spans.

    `full` covers [−1, extent − 1]³.
    """
    k, flat = full.shape[0], full.reshape(-1)
    indices, starts, ends = [], [], []
    for first in range(0, len(rays), chunk):
        part = rays[slice(first, first + chunk)]
        count = max(1, int(((part.t1 - part.t0).max() / step).ceil()))
        t = part.t0[:, None] + (torch.arange(count) + 0.5) * step
        cell = torch.zeros_like(t, dtype=torch.int32)
        for axis in range(3):
            x = torch.addcmul(part.o[:, axis:axis + 1] + 1, part.d[:, axis:axis + 1], t)
            cell = cell * k + x.mul_(k / extent).int().clamp_(0, k - 1)
        hit = flat[cell]
        hit &= t < part.t1[:, None] + step
        meeting = hit.any(1).nonzero()[:, 0]
        hit = hit[meeting].to(torch.uint8)
        a, b = hit.argmax(1), count - 1 - hit.flip(1).argmax(1)
        indices.append(meeting + first)
        starts.append(torch.maximum(part.t0[meeting] + (a - 0.5) * step, part.t0[meeting]))
        ends.append(torch.minimum(part.t0[meeting] + (b + 1.5) * step, part.t1[meeting]))
    if not indices:
        return torch.arange(0), rays
    index = torch.cat(indices)
    return index, replace(rays[index], t0=torch.cat(starts), t1=torch.cat(ends))


@torch.no_grad()
def from_networks(networks: Networks, cells: int, threshold: float, generator: torch.Generator) -> Occupancy:
    """Return the occupancy of a field without photographs.

    Full cells are those of the unit ball with σ > `threshold` at one of four random points, and their neighbours.
    """
    grid = Occupancy(cell_centers(cells).norm(dim=-1) < 1)
    best = torch.zeros(len(grid.index))
    for _ in range(4):
        best = torch.maximum(best, in_parts(networks.density, grid.positions(grid.index, generator)))
    full = torch.zeros(cells**3)
    full[grid.index] = (best > threshold).float()
    near = neighbour_maximum(full.view((cells,) * 3)).view(-1)[grid.index] > 0
    grid.sigma[grid.index] = torch.where(near, best.clamp(max=20.0), -1.0)
    return grid
