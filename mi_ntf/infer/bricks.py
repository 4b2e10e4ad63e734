"""Sparse volumes: bricks of 8³ trilinear cells that hold matter, and an index that also skips empty space."""

import itertools
from collections.abc import Sequence
from types import ModuleType

import drjit as dr
import numpy as np

from ..core.errors import MiNtfError
from . import ops
from .backend import words
from .types import Float, Mask, Place, UInt32, Vector

SIDE = 8
"""Cells along an edge of a brick. A brick holds the 9³ voxels around its cells, so neighbours share a face."""
LINE, LAYER, WORDS = SIDE, SIDE * (SIDE + 1), SIDE * (SIDE + 1) ** 2
"""Words of a line of voxels, of a layer of lines, and of a brick, for each channel."""
OPAQUE = 16.0
"""Upper bound of a voxel's optical depth. More would cost digits elsewhere, since voxels have 16 bits."""
PART = 4096
"""Number of bricks that are packed together."""
FARTHEST = 15
"""Largest distance to the next brick that the index holds, in bricks."""
OCTANTS, _DISTANCE = 20, 28
"""First bits of an index entry's octants and distance; the bits below hold the number of the brick."""
NUMBER = (1 << OCTANTS) - 1
"""Bits of an index entry that hold the number of the brick."""


def bricks_per_side(resolution: int) -> int:
    """Return the number of bricks along an edge of a volume of `resolution`³ voxels."""
    return -(-(resolution - 1) // SIDE)


class Bricks:
    """Channels of trilinear numbers on [−1, 1]³, sampled at the centres of `resolution`³ voxels.

    Parameters
    ----------
    arrays
        Result of :func:`pack`. Raises ValueError if they cannot be that.
    dj
        Dr.Jit module of the back end.

    Notes
    -----
    A word holds the 16-bit levels of a voxel and of the next one along x, so a lookup takes four fetches for each
    channel and one of the index. An entry of the index is the number of a brick, one bit for each of its octants that
    holds matter, and the distance to the next brick that does. Brick 0 is empty.

    Points outside the voxels' centres read the nearest voxels. :meth:`place` does the work that lookups and clear
    distances at the same points share.
    """

    def __init__(self, arrays: dict[str, np.ndarray], dj: ModuleType):
        check(arrays)
        self._dj, self.resolution = dj, int(arrays["resolution"][0])
        self.channels, self.side = arrays["range"].shape[1], bricks_per_side(self.resolution)
        self.index, self.words = (words(arrays[name], dj) for name in ("index", "words"))
        n = self.resolution
        last = np.nextafter(np.float32(n - 1), np.float32(0))  # of the last cell, whose next voxel is there
        self._half, self._first, self._last, self._voxel = (
            dr.opaque(dj.Float, v) for v in (n / 2, n / 2 - 0.5, last, 2 / n))
        self._bricks, self._size = (dr.opaque(dj.UInt32, v) for v in (self.side, self.channels * WORDS))
        self.low, self.step = ([dr.opaque(dj.Float, float(v)) for v in row] for row in arrays["range"])

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return 4 * (dr.width(self.words) + dr.width(self.index))

    def place(self, p: Vector) -> Place:
        """Return the places of `p`: by axis in voxels from the first centre, and their entries in the index."""
        # NaN must not become an index.
        place = [ops.fmin(ops.fmax(dr.fma(self._half, c, self._first), 0), self._last) for c in p]
        x, y, z = (self._dj.UInt32(f) >> 3 for f in place)
        return *place, dr.gather(self._dj.UInt32, self.index, (z * self._bricks + y) * self._bricks + x)

    def at(self, place: Place) -> list[Float]:
        """Return the channels at a :meth:`place`."""
        *cell, entry = place
        corner = [self._dj.UInt32(f) for f in cell]
        fx, fy, fz = (f - self._dj.Float(i) for f, i in zip(cell, corner, strict=True))
        x, y, z = (c & (SIDE - 1) for c in corner)
        first = (entry & NUMBER) * self._size + z * LAYER + y * LINE + x

        def along_x(index: UInt32) -> Float:
            word = dr.gather(self._dj.UInt32, self.words, index)
            low = self._dj.Float(word & 0xFFFF)
            return low + fx * (self._dj.Float(word >> 16) - low)

        def along_y(index: UInt32) -> Float:
            low = along_x(index)
            return low + fy * (along_x(index + LINE) - low)

        result = []
        for channel, (low, step) in enumerate(zip(self.low, self.step, strict=True)):
            near = along_y(first + channel * WORDS)
            result.append(low + step * (near + fz * (along_y(first + (channel * WORDS + LAYER)) - near)))
        return result

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs through empty space from a :meth:`place`; 0 where there may be matter.

        `inverse_d`: componentwise 1/direction (finite). The distance ends at the empty octant, or at the empty cube of
        bricks around an empty brick.
        """
        *cell, entry = place
        n = entry >> _DISTANCE
        half = [self._dj.UInt32(f) >> 2 for f in cell]  # in halves of bricks
        x, y, z = (h & 1 for h in half)
        empty = ((entry >> (OCTANTS + x + 2 * y + 4 * z)) & 1) == 0
        whole, distance = n > 0, dr.inf
        ahead = self._dj.Float(dr.select(whole, 2 * n, 1))
        behind = self._dj.Float(dr.select(whole, 2, 1)) - ahead
        for f, h, inverse in zip(cell, half, inverse_d, strict=True):
            begin = self._dj.Float(dr.select(whole, h & ~self._dj.UInt32(1), h))
            face = begin + dr.select(inverse > 0, ahead, behind)
            distance = dr.minimum(distance, ((SIDE // 2) * face - f) * inverse)
        return dr.select(empty, dr.maximum(distance * self._voxel, 0), 0)

    def occupied(self, place: Place) -> Mask:
        """Return True where a :meth:`place` lies in a brick that holds matter."""
        return (place[-1] & NUMBER) > 0

    def distances(self) -> np.ndarray:
        """Return the Chebyshev distance of each brick (z, y, x) to the next one that holds matter, in bricks."""
        distances: np.ndarray = (self.index.numpy() >> _DISTANCE).reshape((self.side,) * 3)
        return distances


def pack(values: np.ndarray, places: np.ndarray, octants: np.ndarray, resolution: int,
         empty: float) -> dict[str, np.ndarray]:
    """Return the arrays of a :class:`Bricks`.

    Parameters
    ----------
    values
        (bricks, channels, 9, 9, 9) float32, the last three axes z, y, x.
    places
        (bricks, 3) positions of the bricks, z first, in bricks.
    octants
        (bricks, 2, 2, 2) bool, z first: the octants that hold matter.
    resolution
        Voxels along an edge of the volume.
    empty
        Upper bound of every channel where there is no brick. Values are stored to 1/65535 of their channel's range.

    Raises
    ------
    MiNtfError
        There are more bricks than the index can number.
    """
    if len(values) >= 1 << OCTANTS:
        raise MiNtfError(f"a field of {resolution}³ voxels takes {len(values)} bricks, more than the "
                         f"{(1 << OCTANTS) - 1} that can be numbered; give the nrf medium a lower resolution")
    side, count, channels = bricks_per_side(resolution), *values.shape[:2]
    index = np.zeros((side,) * 3, np.uint32)
    bits = octants.reshape(-1, 8).astype(np.uint32) @ (1 << np.arange(8, dtype=np.uint32))
    index[tuple(places.T)] = np.arange(1, count + 1) | bits << OCTANTS
    index |= chebyshev_distance(index > 0).astype(np.uint32) << _DISTANCE
    low, high = (np.full(channels, empty, np.float32) for _ in range(2))
    if count:
        low, high = (pick(bound, extreme((0, 2, 3, 4))) for pick, bound, extreme in (
            (np.minimum, low, values.min), (np.maximum, high, values.max)))
    step = np.where(high > low, high - low, np.float32(1)) / np.float32(0xFFFF)
    result = np.zeros((count + 1, channels, SIDE + 1, SIDE + 1, SIDE), np.uint32)
    for channel in range(channels):
        for first in range(0, count, PART):  # bounds the memory
            part = slice(first, first + PART)
            levels = np.round((values[part, channel] - low[channel]) / step[channel]).astype(np.uint32)
            result[1:][part, channel] = levels[..., :-1] | levels[..., 1:] << 16
    return {"index": index, "words": result, "range": np.stack([low, step]), "resolution": np.array([resolution])}


def check(arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError if a lookup in `arrays`, which may come from a file, would read outside of their memory."""
    index, stored, ranges, resolution = (
        arrays.get(name, np.zeros(0)) for name in ("index", "words", "range", "resolution"))
    side = bricks_per_side(int(resolution[0])) if resolution.size == 1 else 0
    fits = (stored.ndim == 5 and stored.shape[2:] == (SIDE + 1, SIDE + 1, SIDE) and ranges.shape == (2, stored.shape[1])
            and index.shape == (side,) * 3 and index.dtype == stored.dtype == np.uint32)
    if not fits or not np.isfinite(ranges).all() or (index & NUMBER).max() >= len(stored):
        raise ValueError("these are no bricks")


def of_dense(values: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays of a :class:`Bricks` of `values` (z, y, x, channels) around the voxels of `mask`.

    Where the axes differ in length, the voxels fill the lowest corner of a cube.
    """
    n = max(mask.shape)
    first = SIDE * np.arange(bricks_per_side(n))
    places = np.argwhere(any_between(mask, first, first + SIDE))
    last = np.array(mask.shape)[:, None] - 1
    voxels = np.minimum(SIDE * places[..., None] + np.arange(SIDE + 1), last)  # (bricks, axis, 9)
    z, y, x = voxels[:, 0, :, None, None], voxels[:, 1, None, :, None], voxels[:, 2, None, None, :]
    return pack(np.moveaxis(values[z, y, x], -1, 1), places, octants_of(mask[z, y, x]), n, 0.0)


def to_dense(arrays: dict[str, np.ndarray], counts: Sequence[int]) -> np.ndarray:
    """Return the first channel (z, y, x) of the arrays of a :class:`Bricks`; `counts`: voxels along x, y and z."""
    number = arrays["index"] & np.uint32(NUMBER)
    low, step = arrays["range"][:, 0]
    result = np.zeros((SIDE * number.shape[0] + 1,) * 3, np.float32)
    for z, y, x in np.argwhere(number > 0):
        stored = arrays["words"][number[z, y, x], 0]
        levels = np.concatenate([stored & 0xFFFF, stored[..., -1:] >> 16], 2)
        first = SIDE * np.array([z, y, x])
        result[tuple(slice(a, a + SIDE + 1) for a in first)] = low + step * levels.astype(np.float32)
    return result[: counts[2], : counts[1], : counts[0]]


def octants_with_matter(index: np.ndarray) -> np.ndarray:
    """Return a mask (z, y, x) of the octants of all bricks that hold matter, by the `index` of a :func:`pack`."""
    side = index.shape[0]
    bits = index[:, None, :, None, :, None] >> (OCTANTS + np.arange(8, dtype=np.uint32)).reshape(1, 2, 1, 2, 1, 2)
    number = index & np.uint32(NUMBER)
    result: np.ndarray = ((bits & 1) == 1) & (number > 0)[:, None, :, None, :, None]
    return result.reshape(2 * side, 2 * side, 2 * side)


def octants_of(dense: np.ndarray) -> np.ndarray:
    """Return a mask of the octants (bricks, 2, 2, 2) that interpolate a voxel that is `dense` (bricks, 9, 9, 9)."""
    half = SIDE // 2
    parts = [dense[:, z : z + half + 1, y : y + half + 1, x : x + half + 1].any((1, 2, 3))
             for z, y, x in itertools.product((0, half), repeat=3)]
    return np.stack(parts, 1).reshape(-1, 2, 2, 2)


def any_between(mask: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return a mask of the cells (z, y, x) that hold a voxel of `mask`; cell k spans voxels first[k] to last[k]."""
    for axis in range(3):
        parts = [mask.take(range(a, min(b + 1, mask.shape[axis])), axis).any(axis)
                 for a, b in zip(first, last, strict=True)]
        mask = np.stack(parts, axis)
    return mask


def chebyshev_distance(occupied: np.ndarray, limit: int = FARTHEST) -> np.ndarray:
    """Return the distance of each cell to the nearest `occupied` one (0 in one), at most `limit`; (z, y, x) uint8."""
    distance = np.zeros(occupied.shape, np.uint8)
    for _ in range(limit):
        distance += ~occupied
        occupied = grown(occupied)
    return distance


def grown(mask: np.ndarray) -> np.ndarray:
    """Return `mask` (z, y, x) with the 26 neighbours of each of its cells."""
    for axis in range(3):
        padded = np.pad(mask, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        n = mask.shape[axis]
        mask = padded.take(range(n), axis) | padded.take(range(1, n + 1), axis) | padded.take(range(2, n + 2), axis)
    return mask
