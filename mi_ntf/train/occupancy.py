"""Where matter is: a coarse grid of densities, so that samples are spent at the visible surface alone."""

import torch
import torch.nn.functional as F

from .networks import Networks
from .rays import Rays

FULL_BELOW = 0.3
"""Cells with σ under this (1/radius) count as empty: a whole cell takes less than 1 % of the light."""
LOG_EMPTY = -4.0
"""ln σ of what counts as empty: a fifth of the renderer's cut at σ = 0.1."""
LOOKS = 1 << 18
"""Cells outside the hull that an update looks at, besides those where it found matter the last time."""
OPAQUE_DEPTH = 10.0
"""Samples behind this optical depth are not drawn: their light came through e^−10 twice."""


class Occupancy:
    """Densities of [−1, 1]³ on cells³ cells, [x, y, z]; `hull` (bool) bounds where matter may be at all."""

    def __init__(self, hull: torch.Tensor):
        self.cells = hull.shape[0]
        self.hull = hull
        self.index = hull.reshape(-1).nonzero()[:, 0]
        self.sigma = torch.full((self.cells**3,), -1.0)
        self.sigma[self.index] = 0.0
        self.level = torch.zeros(len(self.index))
        self.outside = (~hull).reshape(-1).nonzero()[:, 0]
        self.stray = self.outside[:0]
        """Cells outside the hull where the networks still put matter; kept up by :meth:`update`."""

    def positions(self, index: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """One random point (n, 3) in each of the cells `index`."""
        n = self.cells
        corner = torch.stack([index // (n * n), index // n % n, index % n], 1)
        return (corner + torch.rand(corner.shape, generator=generator)) * (2 / n) - 1

    @torch.no_grad()
    def look(self, networks: Networks, generator: torch.Generator, decay: float = 1.0) -> torch.Tensor:
        """Densities at a random point of every cell, which raise its level."""
        new = networks.density(self.positions(self.index, generator))
        self.level = torch.maximum(self.level * decay, new)
        return new

    @torch.no_grad()
    def update(self, networks: Networks, generator: torch.Generator) -> None:
        """Look anew; old levels fade slowly, so that a thin skin is not lost."""
        n = self.cells
        new = self.look(networks, generator, 0.8)
        grid = torch.zeros(n**3)
        grid[self.index] = (self.level > FULL_BELOW).float()
        near = widest(grid.view(n, n, n)).reshape(-1)[self.index] > 0
        # A cell takes as much light as its thinnest neighbour would: skins, which fill cells in part, hide nothing.
        grid[self.index] = new
        least = -widest(-grid.view(n, n, n)).reshape(-1)[self.index]
        self.sigma[self.index] = torch.where(near, least, -1.0)
        some = torch.randint(max(len(self.outside), 1), (min(len(self.outside), LOOKS),), generator=generator)
        some = torch.cat([self.stray, self.outside[some]]).unique()
        x = self.positions(some, generator)
        stray = [networks.log_density(p) > LOG_EMPTY for p in x.split(65536)]
        self.stray = some[torch.cat(stray)] if stray else some

    def must_be_empty(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Points (≤ 2·count, 3) outside the hull: half anywhere, half in cells where matter has strayed."""
        cells = [c[torch.randint(len(c), (count,), generator=generator)] for c in (self.outside, self.stray) if len(c)]
        return self.positions(torch.cat(cells), generator) if cells else torch.zeros(0, 3)

    def lookup(self, x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """σ of the cells that hold the points; −1 marks an empty cell."""
        n = self.cells
        i, j, k = (((c + 1) * (n / 2)).int().clamp(0, n - 1) for c in (x, y, z))
        return self.sigma[(i * n + j) * n + k]

    def tighten(self, rays: Rays) -> tuple[torch.Tensor, Rays]:
        """:class:`Spans` of the cells that are occupied now."""
        n = self.cells
        return Spans((self.sigma >= 0).view(n, n, n))(rays)

    @torch.no_grad()
    def visible(self, rays: Rays, step: float, generator: torch.Generator):
        """Occupied, visible cells of `step` along the rays: packed ``(ray, near)``, ordered along each ray, with the
        distance of their near ends. One random shift a ray: the cells' bounds vary."""
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
    """Which rays meet a cell of `full` (n, n, n) bool, [x, y, z], that covers [−1, 1]³, and between where and where.

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
        """Indices of those `rays`, and they with `t0`, `t1` around the cells."""
        n, edge = self.full.shape[0], self.BLOCK * self.coarse.shape[0]
        extent = 2 * edge / n  # blocks may stick out of [−1, 1]³
        index, rays = _spans(rays, self.coarse, extent, 2 * self.BLOCK / n, chunk)
        fine, rays = _spans(rays, self.full, 2.0, 1 / n, chunk)
        return index[fine], rays

    def points(self) -> torch.Tensor:
        """Centres (k, 3) of the blocks that hold full cells or are beside one that does."""
        width = 2 * self.BLOCK / self.full.shape[0]
        return (self.coarse.nonzero() + 0.5) * width - 1


def widest(grid: torch.Tensor) -> torch.Tensor:
    """The most of each value of a grid (k, k, k) and its 26 neighbours; axis by axis, a fifth of max_pool3d's time."""
    for axis in range(3):
        n = grid.shape[axis]
        out = grid.clone()
        torch.maximum(out.narrow(axis, 0, n - 1), grid.narrow(axis, 1, n - 1), out=out.narrow(axis, 0, n - 1))
        torch.maximum(out.narrow(axis, 1, n - 1), grid.narrow(axis, 0, n - 1), out=out.narrow(axis, 1, n - 1))
        grid = out
    return grid


def _spans(rays: Rays, full: torch.Tensor, extent: float, step: float, chunk: int) -> tuple[torch.Tensor, Rays]:
    """Indices of the rays that find a full cell of `full` (k, k, k) in steps of `step`, and those rays with spans.

    `full` covers [−1, extent − 1]³.
    """
    k, flat = full.shape[0], full.reshape(-1)
    keep, starts, ends = [], [], []
    for first in range(0, len(rays), chunk):
        part = rays[slice(first, first + chunk)]
        count = max(1, int(((part.t1 - part.t0).max() / step).ceil()))
        t = part.t0[:, None] + (torch.arange(count) + 0.5) * step
        cell = torch.zeros_like(t, dtype=torch.int32)
        for axis in range(3):
            x = torch.addcmul(part.o[:, axis:axis + 1] + 1, part.d[:, axis:axis + 1], t)
            cell = cell * k + x.mul_(k / extent).int().clamp_(0, k - 1)
        found = flat[cell]
        found &= t < part.t1[:, None] + step
        some = found.any(1).nonzero()[:, 0]
        found = found[some].to(torch.uint8)
        a, b = found.argmax(1), count - 1 - found.flip(1).argmax(1)
        keep.append(some + first)
        starts.append(torch.maximum(part.t0[some] + (a - 0.5) * step, part.t0[some]))
        ends.append(torch.minimum(part.t0[some] + (b + 1.5) * step, part.t1[some]))
    if not keep:
        return torch.arange(0), rays
    index = torch.cat(keep)
    kept = rays[index]
    return index, Rays(kept.o, kept.d, torch.cat(starts), torch.cat(ends), kept.target, kept.light,
                       kept.view)


@torch.no_grad()
def from_networks(networks: Networks, cells: int, threshold: float, generator: torch.Generator) -> Occupancy:
    """Occupancy of a field without photographs: cells of the unit ball with σ > `threshold` at one of 4 points."""
    axis = (torch.arange(cells) + 0.5) * (2 / cells) - 1
    ball = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1) < 1
    grid = Occupancy(ball)
    best = torch.zeros(len(grid.index))
    for _ in range(4):
        x = grid.positions(grid.index, generator)
        best = torch.maximum(best, torch.cat([networks.density(p) for p in x.split(65536)]))
    full = torch.zeros(cells**3)
    full[grid.index] = (best > threshold).float()
    near = F.max_pool3d(full.view((1, 1) + (cells,) * 3), 3, 1, 1).view(-1)[grid.index] > 0
    grid.sigma[grid.index] = torch.where(near, best.clamp(max=20.0), -1.0)
    return grid
