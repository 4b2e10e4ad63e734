"""Whether masks and poses agree: what each mask shows, the visual hull of all other masks must cover.

The hull of all photographs but k is every cell that none of them shows empty. A pixel of mask k that no such cell
covers tells that this mask is too large there, or another one too small, or a pose wrong. Cells count with their whole
extent and pixels are pooled, both such that only real disagreement shows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

CELLS = 28
"""Cells along an edge of the cube around the object, before they are split."""
SPLITS = 2
"""Cells are halved so often: at last one is a 56th of the object's sphere's radius wide."""
PIXELS = 384
"""Masks are pooled to so many pixels a side, at most."""
VIEWS = 60
"""So many photographs are compared, at most."""


class Outline(NamedTuple):
    """One photograph's silhouette."""

    maybe: np.ndarray
    """(H, W) bool: may show the object."""
    surely: np.ndarray
    """(H, W) bool: shows it."""
    c2w: np.ndarray
    """(4, 4) OpenGL camera-to-world."""
    focal: np.ndarray
    principal: np.ndarray
    """(2,) each, pixels."""


def disagreement(outlines: Sequence[Outline], center: np.ndarray, radius: float) -> np.ndarray:
    """Share of each mask's pixels (N,) that the hull of all others does not cover; NaN where it shows nothing.

    `center` (3,), `radius`: the object's sphere, world units. Where the others leave no cell at all the share is 1.
    """
    small = [_pooled(outline) for outline in outlines]
    edge = 2 * radius / CELLS
    cells = edge * (np.stack(np.meshgrid(*3 * [np.arange(CELLS)], indexing="ij"), -1).reshape(-1, 3) + 0.5) - radius
    cells = cells[np.linalg.norm(cells, axis=1) < radius + edge] + center
    corners = np.stack(np.meshgrid(*3 * [[-0.25, 0.25]], indexing="ij"), -1).reshape(8, 3)
    inner = []
    for level in range(1 + SPLITS):
        if level:
            cells, edge = (cells[:, None] + edge * corners).reshape(-1, 3), edge / 2
        empty, full = (np.stack(kind) for kind in zip(*(_seen(o, cells, edge) for o in small), strict=True))
        inner.append((cells[full.all(0)], edge))
        near = (empty.sum(0, dtype=np.int32) < 2) & ~full.all(0)  # where two see nothing, any hull is empty
        cells, empty = cells[near], empty[:, near]
    objectors = empty.sum(0, dtype=np.int32)
    return np.array([_uncovered(outline, [*inner, (cells[objectors == empty[k]], edge)])
                     for k, outline in enumerate(small)])


def chosen(count: int) -> np.ndarray:
    """Which of `count` photographs are compared: evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, VIEWS)).round().astype(int))


def _pooled(outline: Outline) -> Outline:
    """The outline in larger pixels, of which `maybe` grows and `surely` shrinks."""
    height, width = outline.maybe.shape
    step = -(-max(height, width) // PIXELS)
    room = ((0, -height % step), (0, -width % step))

    def blocks(mask: np.ndarray) -> np.ndarray:
        padded = np.pad(mask, room)
        return padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step)

    return Outline(np.any(blocks(outline.maybe), (1, 3)), np.all(blocks(outline.surely), (1, 3)), outline.c2w,
                   outline.focal / step, outline.principal / step)


def _windows(outline: Outline, cells: np.ndarray, edge: float) -> tuple[np.ndarray, ...]:
    """The pixels that each cell (K, 3) may fall on, columns u0 to u1 and rows v0 to v1 (ends left out; none behind the
    camera), and whether its middle is in the image."""
    height, width = outline.maybe.shape
    local = (cells - outline.c2w[:3, 3]) @ outline.c2w[:3, :3]
    depth = -local[:, 2]
    front = depth > edge
    safe = np.where(front, depth, 1.0)
    u = outline.principal[0] + outline.focal[0] * local[:, 0] / safe
    v = outline.principal[1] - outline.focal[1] * local[:, 1] / safe
    slant = np.linalg.norm(local, axis=1) / safe  # lengths along the ray move the pixel too, off the axis
    reach = slant * np.sqrt(3) / 2 * edge * outline.focal.max() / np.maximum(safe - edge, edge)
    inside = front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u0, u1 = (np.clip(np.floor(u + s * reach) + (s > 0), 0, width).astype(np.int32) for s in (-1, 1))
    v0, v1 = (np.clip(np.floor(v + s * reach) + (s > 0), 0, height).astype(np.int32) for s in (-1, 1))
    u1 = np.where(front, u1, u0)
    return u0, u1, v0, v1, inside


def _seen(outline: Outline, cells: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Which cells (K,) the photograph shows empty, their middle in the image and no pixel that may show the object, and
    which are full, all their pixels such ones: so are then all parts of them."""
    u0, u1, v0, v1, inside = _windows(outline, cells, edge)
    sums = np.pad(outline.maybe.astype(np.int32).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    found = sums[v1, u1] - sums[v0, u1] - sums[v1, u0] + sums[v0, u0]
    return inside & (found == 0), found == (u1 - u0) * (v1 - v0)


def _uncovered(outline: Outline, groups: list[tuple[np.ndarray, float]]) -> float:
    """Share of the pixels that surely show the object and that no cell of the `groups` (cells, edge) falls on."""
    total = np.count_nonzero(outline.surely)
    if not total:
        return float("nan")
    height, width = outline.maybe.shape
    row = width + 1
    change = np.zeros((height + 1) * row)  # summed up: how many cells fall on a pixel
    for cells, edge in groups:
        u0, u1, v0, v1, _ = _windows(outline, cells, edge)
        u0, u1, v0, v1 = (side[(u1 > u0) & (v1 > v0)] for side in (u0, u1, v0, v1))
        corners = np.concatenate([v0 * row + u0, v1 * row + u1, v0 * row + u1, v1 * row + u0])
        change += np.bincount(corners, np.repeat([1.0, 1.0, -1.0, -1.0], len(u0)), len(change))
    covered = change.reshape(height + 1, row).cumsum(0).cumsum(1)[:-1, :-1] > 0.5
    return float(np.count_nonzero(outline.surely & ~covered) / total)
