"""The density on a grid, without gradients: targets for the normals."""

import torch
import torch.nn.functional as F

from .networks import Networks
from .occupancy import Occupancy


class NormalTargets:
    """`slope` (1, 3, k, k, k), −∇ of the blurred opacity: [−1, 1]³ as [z, y, x]; comes from :meth:`update`."""

    def __init__(self, cells: int):
        self.cells = cells
        axis = (torch.arange(cells) + 0.5) * (2 / cells) - 1
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        self.centers = torch.stack([x, y, z], -1).reshape(-1, 3)

    @torch.no_grad()
    def update(self, networks: Networks, occupancy: Occupancy) -> None:
        """Evaluate the density at the centres of the cells that the occupancy grid calls full."""
        full = (occupancy.lookup(*self.centers.T) >= 0).nonzero()[:, 0]
        x = self.centers[full]
        value = torch.cat([networks.density(p) for p in x.split(65536)])
        sigma = torch.zeros(len(self.centers))
        sigma[full] = value
        # Opacity of a cell, not σ: a normal should not depend on how opaque an opaque cell is.
        smooth = blur(1 - torch.exp(-sigma.view((self.cells,) * 3) * (4 / self.cells)))
        padded = F.pad(smooth[None, None], (1,) * 6, mode="replicate")[0, 0]
        inner = slice(1, -1)
        self.slope = -torch.stack([padded[inner, inner, 2:] - padded[inner, inner, :-2],
                                   padded[inner, 2:, inner] - padded[inner, :-2, inner],
                                   padded[2:, inner, inner] - padded[:-2, inner, inner]])[None]

    def normals(self, x: torch.Tensor):
        """``(normal (n, 3), certain (n,))``: outward unit normals and whether the density has a clear slope at `x`."""
        slope = fetch(self.slope, x).T
        length = slope.norm(dim=1)
        return slope / length.clamp(min=1e-6)[:, None], length > 0.02


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


def fetch(grid: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Trilinear values (channels, n) of a grid (1, channels, z, y, x) at x (n, 3).

    In two halves, since ``grid_sample`` runs the batch in parallel, not the points.
    """
    n = len(x)
    if n % 2:
        x = torch.cat([x, x[:1]])
    halves = x.reshape(2, -1, 1, 1, 3)
    out = F.grid_sample(grid.expand(2, -1, -1, -1, -1), halves, "bilinear", "border", align_corners=False)
    return out[:, :, :, 0, 0].transpose(0, 1).reshape(grid.shape[1], -1)[:, :n]
