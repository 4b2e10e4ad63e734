"""Agreement of masks and poses: the visual hull of all masks but one must cover the silhouette in that mask.

The hull of all photographs but k consists of the cells that none of them shows empty. If no such cell covers a pixel of
mask k, this mask is too large there, or another one too small, or a pose wrong. Cells count with their whole extent,
and pixels are pooled, so that only real disagreement shows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mi_ntf.data.poses import Footprint, footprint

CELLS = 28  # along an edge of the cube around the object, before they are split
SPLITS = 2  # halvings of cells: a cell of the last level is 1/56 of the radius of the object's sphere wide
PIXELS = 384  # largest side of pooled masks
VIEWS = 60  # largest number of photographs that are compared


class Outline(NamedTuple):
    """Silhouette of one photograph, with its pose (4, 4) and its focal lengths and principal point (2,) in pixels."""

    maybe: np.ndarray  # (H, W) bool: the pixel may show the object
    surely: np.ndarray  # (H, W) bool: the pixel shows it
    c2w: np.ndarray
    focal: np.ndarray
    principal: np.ndarray

    def footprint(self, cells: np.ndarray, edge: float) -> Footprint:
        """Return the windows of pixels on which the cells (K, 3) may fall."""
        return footprint(cells, edge, self.c2w, self.focal, self.principal, (self.maybe.shape[1], self.maybe.shape[0]))


def disagreement(outlines: Sequence[Outline], center: np.ndarray, radius: float) -> np.ndarray:
    """Return the fraction of each mask's pixels (N,) that the hull of all others does not cover.

    It is NaN for masks that show nothing, and 1 where the others leave no cell at all. `center` (3,) and `radius` are
    those of the object's sphere in world units.
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
        empty, full = (np.stack(kind) for kind in zip(*(_classify(o, cells, edge) for o in small), strict=True))
        inner.append((cells[full.all(0)], edge))
        near = (empty.sum(0, dtype=np.int32) < 2) & ~full.all(0)  # two empty views leave nothing of any hull
        cells, empty = cells[near], empty[:, near]
    objectors = empty.sum(0, dtype=np.int32)
    return np.array([_uncovered(outline, [*inner, (cells[objectors == empty[k]], edge)])
                     for k, outline in enumerate(small)])


def chosen(count: int) -> np.ndarray:
    """Return the evenly spaced indices of the photographs, of `count`, that are compared."""
    return np.unique(np.linspace(0, count - 1, min(count, VIEWS)).round().astype(int))


def _pooled(outline: Outline) -> Outline:
    """Return the outline in larger pixels: `maybe` grows and `surely` shrinks."""
    height, width = outline.maybe.shape
    step = -(-max(height, width) // PIXELS)
    room = ((0, -height % step), (0, -width % step))

    def blocks(mask: np.ndarray) -> np.ndarray:
        padded = np.pad(mask, room)
        return padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step)

    return Outline(np.any(blocks(outline.maybe), (1, 3)), np.all(blocks(outline.surely), (1, 3)), outline.c2w,
                   outline.focal / step, outline.principal / step)


def _classify(outline: Outline, cells: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells (K,) the photograph shows empty, and which full.

    The centre of an empty cell is in the image, and none of its pixels may show the object; all pixels of a full cell
    may, so the same holds for its parts.
    """
    window = outline.footprint(cells, edge)
    pixels = window.pixels(outline.maybe)
    area = (window.right - window.left) * (window.bottom - window.top)
    return window.inside & (pixels == 0), pixels == area


def _uncovered(outline: Outline, groups: list[tuple[np.ndarray, float]]) -> float:
    """Return the fraction of the surely covered pixels on which no cell of the `groups` (cells, edge) falls."""
    total = np.count_nonzero(outline.surely)
    if not total:
        return float("nan")
    height, width = outline.maybe.shape
    row = width + 1
    change = np.zeros((height + 1) * row)  # its sums are the number of cells on each pixel
    for cells, edge in groups:
        window = outline.footprint(cells, edge)
        u0, u1, v0, v1 = (side[(window.right > window.left) & (window.bottom > window.top)] for side in window[:4])
        corners = np.concatenate([v0 * row + u0, v1 * row + u1, v0 * row + u1, v1 * row + u0])
        change += np.bincount(corners, np.repeat([1.0, 1.0, -1.0, -1.0], len(u0)), len(change))
    covered = change.reshape(height + 1, row).cumsum(0).cumsum(1)[:-1, :-1] > 0.5
    return float(np.count_nonzero(outline.surely & ~covered) / total)
