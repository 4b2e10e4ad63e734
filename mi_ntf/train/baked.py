"""The density on a grid, without gradients: targets for the normals and for the transmittance network."""

import torch
import torch.nn.functional as F

from ..core import spheres
from . import ops
from .networks import Networks
from .occupancy import Occupancy


class Baked:
    """`sigma` (1, 1, k, k, k) and `slope` (1, 3, k, k, k), −∇ of the blurred opacity: [−1, 1]³ as [z, y, x].

    Both come from :meth:`update`.
    """

    def __init__(self, cells: int):
        self.cells = cells
        axis = (torch.arange(cells) + 0.5) * (2 / cells) - 1
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        self.centers = torch.stack([x, y, z], -1).reshape(-1, 3)
        self.reach = 1.0
        """Radius of the ball around the origin that holds all matter."""

    @torch.no_grad()
    def update(self, networks: Networks, occupancy: Occupancy) -> None:
        """Evaluate the density at the centres of the cells that the occupancy grid calls full."""
        full = (occupancy.lookup(*self.centers.T) >= 0).nonzero()[:, 0]
        x = self.centers[full]
        value = torch.cat([networks.density(p) for p in x.split(65536)])
        sigma = torch.zeros(len(self.centers))
        sigma[full] = value
        self.sigma = sigma.view(1, 1, *(self.cells,) * 3)
        dense = x[value > 1]
        self.reach = min(1.0, float(dense.norm(dim=1).max()) + 2 / self.cells) if len(dense) else 1.0
        # Opacity of a cell, not σ: a normal should not depend on how opaque an opaque cell is.
        smooth = blur(1 - torch.exp(-self.sigma[0, 0] * (4 / self.cells)))
        padded = F.pad(smooth[None, None], (1,) * 6, mode="replicate")[0, 0]
        inner = slice(1, -1)
        self.slope = -torch.stack([padded[inner, inner, 2:] - padded[inner, inner, :-2],
                                   padded[inner, 2:, inner] - padded[inner, :-2, inner],
                                   padded[2:, inner, inner] - padded[:-2, inner, inner]])[None]

    def normals(self, x: torch.Tensor):
        """``(normal (n, 3), certain (n,))``: outward unit normals and whether the density has a clear slope at `x`."""
        slope = _fetch(self.slope, x).T
        length = slope.norm(dim=1)
        return slope / length.clamp(min=1e-6)[:, None], length > 0.02

    @torch.no_grad()
    def march(self, m: torch.Tensor, d: torch.Tensor, h: torch.Tensor, steps: int, generator: torch.Generator):
        """Optical depth (n, steps + 1) from equidistant points of the chords, −h … h, to their light-side ends +h.

        One trilinear density a cell, at a random place in it.
        """
        width = 2 * h / steps
        t = (torch.arange(steps) + torch.rand(len(m), steps, generator=generator)) * width[:, None] - h[:, None]
        x = m[:, None] + t[:, :, None] * d[:, None]
        sigma = _fetch(self.sigma, x.reshape(-1, 3))[0].view(len(m), steps)
        depth = (sigma * width[:, None]).flip(1).cumsum(1).flip(1)
        return torch.cat([depth, depth.new_zeros(len(m), 1)], 1)


def blur(grid: torch.Tensor, deviation: float = 1.25) -> torch.Tensor:
    """Gaussian blur of a 3-D grid along its three axes; `deviation` in cells. Wide enough to hide the cells' steps."""
    reach = int(2.5 * deviation) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation) ** 2)
    kernel /= kernel.sum()
    for axis in range(3):
        pad = [0] * 6
        pad[2 * (2 - axis)] = pad[2 * (2 - axis) + 1] = reach
        wide = F.pad(grid, pad)
        grid = sum(k * wide.narrow(axis, i, grid.shape[axis]) for i, k in enumerate(kernel.tolist()))
    return grid


def _fetch(grid: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Trilinear values (channels, n) of a grid (1, channels, z, y, x) at x (n, 3).

    In two halves, since ``grid_sample`` runs the batch in parallel, not the points.
    """
    n = len(x)
    if n % 2:
        x = torch.cat([x, x[:1]])
    halves = x.reshape(2, -1, 1, 1, 3)
    out = F.grid_sample(grid.expand(2, -1, -1, -1, -1), halves, "bilinear", "border", align_corners=False)
    return out[:, :, :, 0, 0].transpose(0, 1).reshape(grid.shape[1], -1)[:, :n]


def uniform_directions(n: int, generator: torch.Generator) -> torch.Tensor:
    """`n` unit vectors (n, 3), uniform on the sphere."""
    return F.normalize(torch.randn(n, 3, generator=generator), dim=1)


def random_chords(n: int, reach: float, generator: torch.Generator):
    """Chords of two uniform points on the sphere (method.md, section 5) that meet the ball of radius `reach`.

    Returns a point and the direction of each, (n, 3). Such a line has a uniform direction, and the square of its
    distance from the centre is uniform too: so no chord has to be drawn in vain.
    """
    d = uniform_directions(n, generator)
    across = F.normalize(torch.linalg.cross(d, uniform_directions(n, generator)), dim=1)
    radius = reach * torch.rand(n, generator=generator).sqrt()
    return across * radius[:, None], d


def chords(o: torch.Tensor, d: torch.Tensor):
    """``(m, h)``, midpoints (n, 3) and half chords (n,) of lines that meet the sphere."""
    _, m, h = spheres.chord(ops, o.unbind(1), d.unbind(1))
    return torch.stack(m, 1), h
