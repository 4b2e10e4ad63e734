"""Density on a grid, without gradients, from which the target normals are taken."""

import torch
import torch.nn.functional as F

from .networks import Networks, in_parts
from .occupancy import Occupancy
from .rays import cell_centers


class NormalTargets:
    """Target normals on a grid of `cells`³ cells over [−1, 1]³, filled by :meth:`update`."""

    def __init__(self, cells: int):
        self.cells = cells
        self.slope = torch.zeros(0)
        """Negative gradient of the blurred opacity (1, 3, cells, cells, cells), [z, y, x]; empty before an update."""
        self.centers = cell_centers(cells).flip(-1).reshape(-1, 3)

    @torch.no_grad()
    def update(self, networks: Networks, occupancy: Occupancy) -> None:
        """Evaluate the density at the centres of the cells that the occupancy grid marks as full."""
        full = (occupancy.lookup(*self.centers.T) >= 0).nonzero()[:, 0]
        sigma = torch.zeros(len(self.centers))
        sigma[full] = in_parts(networks.density, self.centers[full])
        # Opacity of a cell, not σ: a normal should not depend on how opaque an opaque cell is.
        smooth = blur(1 - torch.exp(-sigma.view((self.cells,) * 3) * (4 / self.cells)))
        padded = F.pad(smooth[None, None], (1,) * 6, mode="replicate")[0, 0]
        inner = slice(1, -1)
        self.slope = -torch.stack([padded[inner, inner, 2:] - padded[inner, inner, :-2],
                                   padded[inner, 2:, inner] - padded[inner, :-2, inner],
                                   padded[2:, inner, inner] - padded[:-2, inner, inner]])[None]

    def normals(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return ``(normal (n, 3), certain (n,))`` at the points `x` (n, 3).

        Normals are outward unit vectors; they are certain where the density has a clear slope.
        """
        slope = fetch(self.slope, x).T
        length = slope.norm(dim=1)
        return slope / length.clamp(min=1e-6)[:, None], length > 0.02


def blur(grid: torch.Tensor, deviation: float = 1.25) -> torch.Tensor:
    """Return the Gaussian blur of a 3-D grid. The `deviation`, in cells, is wide enough to hide the steps of cells."""
    reach = int(2.5 * deviation) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / deviation) ** 2)
    kernel /= kernel.sum()
    for axis in range(3):
        pad = [0] * 6
        pad[2 * (2 - axis)] = pad[2 * (2 - axis) + 1] = reach
        wide = F.pad(grid, pad)
        blurred = torch.zeros_like(grid)
        for i, k in enumerate(kernel.tolist()):
            blurred = blurred + k * wide.narrow(axis, i, grid.shape[axis])
        grid = blurred
    return grid


def fetch(grid: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Return trilinear values (channels, n) of a grid (1, channels, z, y, x) at the points `x` (n, 3).

    The points are split in two halves, since ``grid_sample`` runs the batch in parallel, not the points.
    """
    n = len(x)
    if n % 2:
        x = torch.cat([x, x[:1]])
    halves = x.reshape(2, -1, 1, 1, 3)
    values = F.grid_sample(grid.expand(2, -1, -1, -1, -1), halves, "bilinear", "border", align_corners=False)
    return values[:, :, :, 0, 0].transpose(0, 1).reshape(grid.shape[1], -1)[:, :n]
