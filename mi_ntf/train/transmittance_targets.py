"""Marched transmittance, without gradients, from which the transmittance network learns, and rays to march."""

import torch
import torch.nn.functional as F

from ..core import spheres
from ..core.architecture import LOG_FLOOR, MAX_LOG_DENSITY
from . import ops
from .networks import Networks, in_parts
from .normal_targets import fetch
from .occupancy import Occupancy
from .rays import sphere_span

CUT = 0.1
"""Density σ below which the renderer treats space as empty."""
STEP = 1 / 128
"""Step of :func:`walk`, in radii of the unit sphere."""
BLOCK = 16
"""Steps of :func:`walk` after which finished rays are dropped."""
SCALE = 2
"""Voxels per cell of the occupancy grid, along an edge."""


class TransmittanceTargets:
    """Density on a grid, baked as the renderer does it; filled by :meth:`update`."""

    def __init__(self) -> None:
        self.log_sigma = torch.zeros(0)
        """ln σ (1, 1, k, k, k) on [−1, 1]³ as [z, y, x]; empty before an update."""
        self.reach = 1.0  # Radius of the ball around the origin that holds all matter

    @property
    def known(self) -> bool:
        """True once the grid is filled."""
        return self.log_sigma.numel() > 0

    @torch.no_grad()
    def update(self, networks: Networks, occupancy: Occupancy) -> None:
        """Evaluate the density at the voxels of the cells that the occupancy grid marks as full."""
        n = occupancy.cells
        full = (occupancy.sigma >= 0).view(n, n, n).permute(2, 1, 0)
        for axis in range(3):
            full = full.repeat_interleave(SCALE, axis)
        k = n * SCALE
        index = full.reshape(-1).nonzero()[:, 0]
        x = (torch.stack([index % k, index // k % k, index // (k * k)], 1) + 0.5) * (2 / k) - 1
        value = in_parts(networks.log_density, x)
        grid = torch.full((k**3,), LOG_FLOOR)
        grid[index] = value.clamp(LOG_FLOOR, MAX_LOG_DENSITY)
        grid = grid.view(1, 1, k, k, k)
        highest = grid.max()
        for axis in range(2, 5):  # like the renderer's voxels, which are right on average after interpolation
            ends = grid.narrow(axis, 0, 1), grid.narrow(axis, k - 1, 1)
            wide = torch.cat([ends[0], grid, ends[1]], axis)
            grid = (14 * grid - wide.narrow(axis, 0, k) - wide.narrow(axis, 2, k)) / 12
        self.log_sigma = grid.clamp(max=highest)
        dense = x[value.exp() > CUT]
        self.reach = min(1.0, float(dense.norm(dim=1).max()) + 2 / k) if len(dense) else 1.0

    @torch.no_grad()
    def march(self, m: torch.Tensor, d: torch.Tensor, h: torch.Tensor, steps: int) -> torch.Tensor:
        """Return optical depths (n, steps + 1) from equidistant points of chords, −h … h, to their light-side ends.

        `m`, `d` (n, 3) are midpoints and directions, `h` (n,) half chords. One density, trilinear in ln σ, is taken in
        the middle of each step.
        """
        width = 2 * h / steps
        t = (torch.arange(steps) + 0.5) * width[:, None] - h[:, None]
        x = m[:, None] + t[:, :, None] * d[:, None]
        sigma = fetch(self.log_sigma, x.reshape(-1, 3))[0].view(len(m), steps).exp()
        sigma = torch.where(sigma > CUT, sigma, 0.0)
        depth = (sigma * width[:, None]).flip(1).cumsum(1).flip(1)
        return torch.cat([depth, depth.new_zeros(len(m), 1)], 1)


def uniform_directions(n: int, generator: torch.Generator) -> torch.Tensor:
    """Return `n` unit vectors (n, 3), uniform on the sphere."""
    return F.normalize(torch.randn(n, 3, generator=generator), dim=1)


def random_chords(n: int, reach: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a point and the direction, (n, 3) each, of random chords that meet the ball of radius `reach`.

    They are distributed as chords of two uniform points on the sphere (Shafiei et al. 2021): directions are uniform,
    and so is the square of the distance from the centre. So no sample has to be rejected.
    """
    d = uniform_directions(n, generator)
    across = F.normalize(torch.linalg.cross(d, uniform_directions(n, generator)), dim=1)
    radius = reach * torch.rand(n, generator=generator).sqrt()
    return across * radius[:, None], d


def chords(o: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return midpoints (n, 3) and half chords (n,) of the lines through `o` along `d` (n, 3), which meet the sphere."""
    _, m, h = spheres.chord(ops, o.unbind(1), d.unbind(1))
    return torch.stack(m, 1), h


def walk(marched: TransmittanceTargets, o: torch.Tensor, d: torch.Tensor, until: float,
         reach: torch.Tensor | float = torch.inf) -> tuple[torch.Tensor, torch.Tensor]:
    """March rays from `o` along `d` (n, 3) to the optical depth `until` or the distance `reach`, (n,) or one number.

    Returns ``(t, depth)``, (n,) each. `t` is the distance at which a ray passes `until`, infinity if it does not in the
    unit sphere. `depth` is the optical depth at its end, up to BLOCK steps behind the place where it passes `until`.
    """
    t, depth = torch.full((len(o),), torch.inf), torch.zeros(len(o))
    start, end = sphere_span(o, d)
    start = torch.where((o * o).sum(1) < 1, 0.0, start)
    end = torch.minimum(end, torch.as_tensor(reach))
    active, first = (end > start).nonzero()[:, 0], 0
    while len(active):
        k = first + torch.arange(BLOCK)
        along = start[active, None] + (k + 0.5) * STEP
        x = o[active, None] + along[:, :, None] * d[active, None]
        sigma = fetch(marched.log_sigma, x.reshape(-1, 3))[0].view(along.shape).exp()
        sigma = torch.where((sigma > CUT) & (along < end[active, None]), sigma, 0.0)
        total = depth[active, None] + (sigma * STEP).cumsum(1)
        passed = total >= until
        stopped = passed.any(1)
        place = passed.to(torch.uint8).argmax(1, keepdim=True)
        over = (total.gather(1, place) - until) / (sigma.gather(1, place) * STEP).clamp(min=1e-9)
        at = along.gather(1, place) + (0.5 - over.clamp(0, 1)) * STEP
        t[active] = torch.where(stopped, at[:, 0], t[active])
        depth[active] = total[:, -1]
        first += BLOCK
        active = active[~stopped & (start[active] + first * STEP < end[active])]
    return t, depth
