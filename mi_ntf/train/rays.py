"""Photographs as camera rays in field coordinates, and the visual hull that they leave."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ..core import spheres
from ..core.errors import MiNtfError
from ..data.images import LINEAR
from ..data.schema import Split
from . import ops


@dataclass(frozen=True)
class Rays:
    """Camera rays (n) in field coordinates."""

    o: torch.Tensor  # Origins (n, 3)
    d: torch.Tensor  # Unit directions (n, 3)
    t0: torch.Tensor  # Distance (n,) at which the march begins
    t1: torch.Tensor  # Distance (n,) at which the march ends
    target: torch.Tensor  # Pixels (n, 4), linear premultiplied RGBA
    light: torch.Tensor  # Radiant intensity of the light over radius² (n, 3): I/d² in scene units is light/t²
    view: torch.Tensor  # Numbers (n,) of the photographs, counted over all splits

    def __len__(self) -> int:
        return len(self.o)

    def __getitem__(self, index: torch.Tensor | slice) -> "Rays":
        return Rays(self.o[index], self.d[index], self.t0[index], self.t1[index], self.target[index],
                    self.light[index], self.view[index])


ON_LENS = 0.02
"""Distance between light and lens, in object radii, up to which they count as one."""


class Photographs:
    """Photographs of a split, as they are stored, and the camera rays through their pixels, frame by frame, row by row.

    Pixels are decoded and rays computed on demand, so that a data set takes 4 to 8 bytes a pixel. `views` is the number
    of photographs, `height` and `width` are in pixels, and `first` is the number of the first photograph among those
    of all splits.
    """

    def __init__(self, split: Split, first: int = 0):
        self.views, self.height, self.width = split.images.shape[:3]
        self.first, self.names, self.masked = first, split.names, split.masked
        self.stored = torch.as_tensor(split.images).reshape(-1, 4)
        self.quantized = self.stored.dtype == torch.uint8
        """True if pixels are 8-bit levels, which are clipped at both ends."""
        exact = functools.partial(torch.as_tensor, dtype=torch.float64)
        self.rotation = exact(split.c2w[:, :3, :3])
        self.origin = exact((split.c2w[:, :3, 3] - split.center) / split.radius)
        self.focal, self.principal = exact(split.focal), exact(split.principal)
        self.flash = exact((split.light_pos - split.center) / split.radius)
        """Positions of the lights (views, 3), field coordinates."""
        self.light = torch.as_tensor(split.light_intensity / split.radius**2).float()
        self.windows = torch.tensor([0, self.height, 0, self.width]).expand(self.views, 4)
        """First and last row, first and last column of the pixels that :meth:`random` samples (views, 4), the last
        ones exclusive."""

    def __len__(self) -> int:
        return len(self.stored)

    @property
    def on_lens(self) -> bool:
        """True if all lights are at their lenses."""
        return bool((self.flash - self.origin).norm(dim=1).max() <= ON_LENS)

    def pixels(self, index: torch.Tensor) -> torch.Tensor:
        """Return the linear premultiplied RGBA (n, 4) of the pixels `index` (n,)."""
        stored: torch.Tensor = self.stored[index]
        if not self.quantized:
            return stored.float()
        return torch.cat([torch.as_tensor(LINEAR)[stored[:, :3].int()], stored[:, 3:] / 255.0], 1)

    def __getitem__(self, index: torch.Tensor | slice) -> Rays:
        """Return the rays through the pixels `index` (n,); `t0` and `t1` are their ends within the unit sphere."""
        if isinstance(index, slice):
            index = torch.arange(len(self))[index]
        frame, place = index // (self.height * self.width), index % (self.height * self.width)
        image = torch.stack([place % self.width, place // self.width], 1) + 0.5
        across = (image - self.principal[frame]) / self.focal[frame]
        local = torch.stack([across[:, 0], -across[:, 1], -torch.ones_like(across[:, 0])], 1)
        d = F.normalize((self.rotation[frame] @ local[:, :, None])[:, :, 0], dim=1).float()
        o = self.origin[frame].float()
        return Rays(o, d, *sphere_span(o, d), self.pixels(index), self.light[frame], frame + self.first)

    def random(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return `count` random pixels of the windows, all equally likely."""
        top, bottom, left, right = self.windows.unbind(1)
        ends = ((bottom - top) * (right - left)).cumsum(0)
        pick = torch.randint(int(ends[-1]), (count,), generator=generator)
        frame = torch.searchsorted(ends, pick, right=True)
        place = ends[frame] - 1 - pick
        wide = (right - left)[frame]
        row = frame * self.height + top[frame] + place // wide
        pixel: torch.Tensor = row * self.width + left[frame] + place % wide
        return pixel

    def look_at(self, points: torch.Tensor, margin: float) -> None:
        """Set the windows around all `points` (n, 3), each with a `margin` around it, in field coordinates."""
        windows = []
        for rotation, origin, focal, principal in zip(self.rotation, self.origin, self.focal, self.principal,
                                                      strict=True):
            local = (points.double() - origin) @ rotation
            depth = -local[:, 2]
            near = depth.clamp(min=2 * margin)
            across = local[:, :2] / near[:, None] * torch.tensor([1.0, -1.0], dtype=torch.float64) * focal + principal
            reach = margin / (near - margin)[:, None] * focal * (local.norm(dim=1) / near)[:, None] + 1
            low, high = (across - reach).amin(0), (across + reach).amax(0)
            size = torch.tensor([self.width, self.height])
            if bool((depth < 2 * margin).any()):  # the camera is among the points
                low, high = torch.zeros(2), size
            low = torch.minimum(low.floor().clamp(min=0).long(), size - 1)
            high = torch.maximum(torch.minimum(high.ceil().long(), size), low + 1)
            windows.append(torch.stack([low[1], high[1], low[0], high[0]]))
        self.windows = torch.stack(windows)

    def frame(self, number: int, stride: int = 1) -> tuple[torch.Tensor, int, int]:
        """Return ``(pixels, row count, column count)`` of photograph `number`, every `stride`-th row and column."""
        rows, columns = (torch.arange(stride // 2, n, stride) for n in (self.height, self.width))
        pixels = ((number * self.height + rows[:, None]) * self.width + columns).reshape(-1)
        return pixels, len(rows), len(columns)


def sphere_span(o: torch.Tensor, d: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the ends ``(t0, t1)`` of rays in the unit sphere, in front of their origins; t1 = t0 for a miss."""
    hit, m, h = spheres.chord(ops, o.unbind(1), d.unbind(1))
    middle = ((torch.stack(m, 1) - o) * d).sum(1)
    t0 = (middle - h).clamp(min=0.01)
    return t0, torch.where(hit, torch.maximum(middle + h, t0), t0)


def pixel_width(split: Split) -> float:
    """Return the width of a pixel of the median photograph at the centre of the unit sphere, in field units."""
    distance = np.linalg.norm(split.c2w[:, :3, 3] - split.center, axis=1) / split.radius
    return float(np.median(distance / split.focal.max(1)))


def cell_centers(cells: int) -> torch.Tensor:
    """Return the centres (cells, cells, cells, 3), [x, y, z], of a grid over [−1, 1]³."""
    axis = (torch.arange(cells) + 0.5) * (2 / cells) - 1
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def visual_hull(photographs: Photographs, cells: int) -> torch.Tensor:
    """Return the cells (cells, cells, cells) bool, [x, y, z], of [−1, 1]³ that no photograph shows empty.

    A cell is empty if an image that contains it has alpha 0 wherever the cell can project to. Raises MiNtfError if no
    cell remains.
    """
    x = cell_centers(cells).reshape(-1, 3)
    inside = (x.norm(dim=1) < 1 + 2 / cells).nonzero()[:, 0]
    x = x[inside]
    height, width = photographs.height, photographs.width
    for number in range(photographs.views):
        (fx, fy), (cx, cy) = photographs.focal[number].tolist(), photographs.principal[number].tolist()
        local = (x - photographs.origin[number].float()) @ photographs.rotation[number].float()
        depth = (-local[:, 2]).clamp(min=1e-3)
        nearest = max(float(depth.min()), 2 / cells)
        reach = math.ceil(math.sqrt(3) / cells * max(fx, fy) / nearest) + 1
        pixels, *_ = photographs.frame(number)
        shown = (photographs.pixels(pixels)[:, 3] >= 1e-3).float().view(1, 1, height, width)
        for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
            shown = F.max_pool2d(shown, size, 1, (size[0] // 2, size[1] // 2))
        u = (cx + fx * local[:, 0] / depth).floor().long()
        v = (cy - fy * local[:, 1] / depth).floor().long()
        visible = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (local[:, 2] < 0)
        empty = visible & (shown[0, 0, v.clamp(0, height - 1), u.clamp(0, width - 1)] == 0)
        x, inside = x[~empty], inside[~empty]
    if not len(inside):
        raise MiNtfError("no point in space is covered by the object in all photographs; check 'transform_matrix' "
                         "(OpenGL axes), 'camera_angle_x' and 'unit_sphere' of transforms_train.json")
    hull = torch.zeros(cells**3, dtype=torch.bool)
    hull[inside] = True
    return hull.view(cells, cells, cells)
