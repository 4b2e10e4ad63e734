"""Photographs as a pool of camera rays in field coordinates, and what of space they leave possibly occupied."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ..core import spheres
from ..core.errors import MiNtfError
from ..data.schema import Split, pixel_rays
from . import ops


@dataclass(frozen=True)
class Rays:
    """n camera rays: `o`, `d` (n, 3) field coordinates, `t0`, `t1` (n,) the piece to march, `target` (n, 4) linear
    premultiplied RGBA, `light` (n, 3) the light's radiant intensity over radius²: I/d² = light/t² in scene units;
    `view` (n,): number of the photograph."""

    o: torch.Tensor
    d: torch.Tensor
    t0: torch.Tensor
    t1: torch.Tensor
    target: torch.Tensor
    light: torch.Tensor
    view: torch.Tensor

    def __len__(self) -> int:
        return len(self.o)

    def __getitem__(self, index) -> "Rays":
        return Rays(*(getattr(self, k)[index] for k in ("o", "d", "t0", "t1", "target", "light", "view")))


def from_split(split: Split, name: str, first: int = 0) -> Rays:
    """All pixels of a split, frame by frame, row by row; photographs are numbered from `first` on. The light must be at
    the camera (method.md, section 2)."""
    n, height, width = split.images.shape[:3]
    away = np.linalg.norm(split.light_pos - split.c2w[:, :3, 3], axis=1) / split.radius
    if away.max() > 0.02:
        raise MiNtfError(f"split '{name}', frame {away.argmax()}: the light is {away.max():.3g} object radii from the "
                         "camera; training needs photographs with a flash at the lens, as `mi-ntf capture` makes them")
    origins, directions = pixel_rays(split.c2w, split.focal, width, height, split.principal)
    origins = (origins - split.center) / split.radius
    intensity = np.broadcast_to((split.light_intensity / split.radius**2)[:, None, None], (n, height, width, 3))
    o, d, light = (torch.as_tensor(np.array(a, np.float32).reshape(-1, 3)) for a in
                   (origins, directions, intensity))
    t0, t1 = sphere_span(o, d)
    view = torch.arange(first, first + n).repeat_interleave(height * width)
    return Rays(o, d, t0, t1, torch.as_tensor(split.images.reshape(-1, 4)), light, view)


def flashes(split: Split) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the lights of the photographs are (frames, 3), field coordinates, and their :class:`Rays`' `light`."""
    place, power = (split.light_pos - split.center) / split.radius, split.light_intensity / split.radius**2
    return torch.as_tensor(place).float(), torch.as_tensor(power).float()


def sphere_span(o: torch.Tensor, d: torch.Tensor):
    """``(t0, t1)`` where the rays are inside the unit sphere and in front of their origin; t1 = t0 where they miss."""
    hit, m, h = spheres.chord(ops, o.unbind(1), d.unbind(1))
    middle = ((torch.stack(m, 1) - o) * d).sum(1)
    t0 = (middle - h).clamp(min=0.01)
    return t0, torch.where(hit, torch.maximum(middle + h, t0), t0)


def pixel_width(split: Split) -> float:
    """Width of a pixel of the median photograph at the unit sphere's centre, field units."""
    distance = np.linalg.norm(split.c2w[:, :3, 3] - split.center, axis=1) / split.radius
    return float(np.median(distance / split.focal.max(1)))


def visual_hull(split: Split, cells: int) -> torch.Tensor:
    """Cells (cells, cells, cells) bool, [x, y, z], of [−1, 1]³ that no photograph shows empty.

    A cell is empty if some image that contains it has alpha 0 wherever the cell can project to.
    """
    axis = (torch.arange(cells) + 0.5) * (2 / cells) - 1
    x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    inside = (x.norm(dim=1) < 1 + 2 / cells).nonzero()[:, 0]
    x = x[inside]
    height, width = split.images.shape[1:3]
    for image, c2w, focal, principal in zip(split.images, split.c2w, split.focal, split.principal, strict=True):
        (fx, fy), (cx, cy) = focal.tolist(), principal.tolist()
        rotation = torch.tensor(c2w[:3, :3], dtype=torch.float32)
        origin = torch.tensor((c2w[:3, 3] - split.center) / split.radius, dtype=torch.float32)
        local = (x - origin) @ rotation
        depth = (-local[:, 2]).clamp(min=1e-3)
        nearest = max(float(depth.min()), 2 / cells)
        reach = math.ceil(math.sqrt(3) / cells * max(fx, fy) / nearest) + 1
        alpha = torch.tensor(image[None, None, :, :, 3])
        alpha = F.max_pool2d(alpha, 2 * reach + 1, 1, reach)[0, 0]
        u = (cx + fx * local[:, 0] / depth).floor().long()
        v = (cy - fy * local[:, 1] / depth).floor().long()
        seen = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (local[:, 2] < 0)
        empty = seen & (alpha[v.clamp(0, height - 1), u.clamp(0, width - 1)] < 1e-3)
        x, inside = x[~empty], inside[~empty]
    if not len(inside):
        raise MiNtfError("no point in space is covered by the object in all photographs; check 'transform_matrix' "
                         "(OpenGL axes), 'camera_angle_x' and 'unit_sphere' of transforms_train.json")
    hull = torch.zeros(cells**3, dtype=torch.bool)
    hull[inside] = True
    return hull.view(cells, cells, cells)
