"""Voxels of bricks as numbers of their own: blocks of 8³ voxels in which each voxel occurs once."""

import copy
import itertools
from types import ModuleType

import drjit as dr
import numpy as np

from . import ops
from .backend import words
from .bricks import LAYER, LINE, NUMBER, OCTANTS, SIDE, WORDS, Bricks
from .types import Array, Float, Mask, UInt32, Vector

VOXELS = SIDE**3
"""Number of voxels of a block."""


class Blocks:
    """Blocks of 8³ voxels that own all voxels of occupied bricks, which share the voxels of their faces.

    Parameters
    ----------
    occupied
        (z, y, x) bool: the bricks that hold matter.
    counts
        Number of voxels along x, y and z.
    dj
        Dr.Jit module of the back end.

    Notes
    -----
    Values are arrays of ``count`` · 8³ · channels numbers: block by block, z, y and x within it, channels last. A block
    has the place of a brick, and there may be a further one at each end. Voxels of a block that no occupied brick reads
    have no effect.
    """

    def __init__(self, occupied: np.ndarray, counts: np.ndarray, dj: ModuleType):
        self._dj, side = dj, occupied.shape[0] + 1
        owned = np.pad(occupied, (0, 1))
        for axis in range(3):
            owned = owned | np.roll(owned, 1, axis)  # the last layer is empty
        self.places = np.argwhere(owned)[:, ::-1]
        self.count = len(self.places)
        slots = np.zeros(owned.shape, np.uint32)
        slots[owned] = np.arange(1, self.count + 1)
        self._slots, self._side = words(slots, dj), dr.opaque(dj.UInt32, side)
        self._places = [words(c, dj) for c in self.places.T]
        self._last = [dr.opaque(dj.UInt32, int(c) - 1) for c in counts]

    def voxels(self) -> tuple[UInt32, UInt32, UInt32]:
        """Return the places of all voxels along x, y and z."""
        index = dr.arange(self._dj.UInt32, self.count * VOXELS)
        block, mine = index // VOXELS, index % VOXELS
        local = mine % SIDE, mine // SIDE % SIDE, mine // SIDE**2
        x, y, z = (dr.gather(self._dj.UInt32, place, block) * SIDE + c
                   for place, c in zip(self._places, local, strict=True))
        return x, y, z

    def number(self, x: UInt32, y: UInt32, z: UInt32) -> tuple[UInt32, Mask]:
        """Return the numbers of the voxels at these places, and a mask of those that a block owns."""
        x, y, z = (dr.minimum(c, last) for c, last in zip((x, y, z), self._last, strict=True))
        bx, by, bz = x // SIDE, y // SIDE, z // SIDE
        slot = dr.gather(self._dj.UInt32, self._slots, (bz * self._side + by) * self._side + bx)
        local = (z % SIDE * SIDE + y % SIDE) * SIDE + x % SIDE
        return dr.select(slot > 0, (slot - 1) * VOXELS + local, 0), slot > 0

    def at(self, values: Float, channels: int, place: Vector) -> list[Float]:
        """Return the channels of `values`, trilinear between the voxels around `place`, in voxels; 0 where none is.

        The result has the gradients of `values` and of `place`.
        """
        corner = [self._dj.UInt32(dr.detach(c)) for c in place]
        fractions = [c - self._dj.Float(i) for c, i in zip(place, corner, strict=True)]
        result: list[Float] = [self._dj.Float(0)] * channels
        for offset in itertools.product((0, 1), repeat=3):
            number, owned = self.number(*(c + o for c, o in zip(corner, offset, strict=True)))
            weight: Float = 1
            for fraction, o in zip(fractions, offset, strict=True):
                weight = weight * (fraction if o else 1 - fraction)
            result = [r + weight * dr.gather(self._dj.Float, values, number * channels + k, owned)
                      for k, r in enumerate(result)]
        return result

    def unpacked(self, content: Bricks) -> list[Float]:
        """Return the values of `content` by channels, as expressions that nothing has evaluated yet."""
        uint, side = self._dj.UInt32, dr.opaque(self._dj.UInt32, content.side)
        voxel = self.voxels()
        block, local = [c // SIDE for c in voxel], [c % SIDE for c in voxel]
        brick, place = uint(0), [uint(0)] * 3
        for back in itertools.product((0, 1), repeat=3):
            # A voxel at the begin of its block may lie on the last face of the brick before.
            there: Mask = brick == 0
            for b, c, o in zip(block, local, back, strict=True):
                there = there & ((c == 0) & (b > 0) if o else b < side)
            x, y, z = (b - o for b, o in zip(block, back, strict=True))
            entry = dr.gather(uint, content.index, (z * side + y) * side + x, there) & NUMBER
            taken = there & (entry > 0)
            brick = dr.select(taken, entry, brick)
            place = [dr.select(taken, c + SIDE * o, p) for c, o, p in zip(local, back, place, strict=True)]
        x, y, z = place
        high = x == SIDE
        first = brick * (content.channels * WORDS) + z * LAYER + y * LINE + dr.select(high, SIDE - 1, x)
        values = []
        for channel, (low, step) in enumerate(zip(content.low, content.step, strict=True)):
            word = dr.gather(uint, content.words, first + channel * WORDS)
            values.append(low + step * self._dj.Float(dr.select(high, word >> 16, word & 0xFFFF)))
        return values

    def repacked(self, content: Bricks, values: Float, least: float, empty: float) -> Bricks:
        """Return a copy of `content`, which has one channel, that holds other `values`.

        `least`: value above which a voxel holds matter; `empty`: value where there is no brick. The bricks stay, and
        octants without matter become empty.
        """
        uint, floats = self._dj.UInt32, self._dj.Float
        index = content.index.numpy().reshape((content.side,) * 3)
        number = index & np.uint32(NUMBER)
        places = np.zeros((int(number.max(initial=0)) + 1, 3), np.int64)
        places[number[number > 0]] = np.argwhere(number > 0)[:, ::-1]
        place = [words(c, self._dj) for c in places.T]

        def value(brick: UInt32, x: UInt32, y: UInt32, z: UInt32) -> Float:
            voxel = (dr.gather(uint, c, brick) * SIDE + o for c, o in zip(place, (x, y, z), strict=True))
            number, owned = self.number(*voxel)
            return dr.gather(floats, values, number, owned & (brick > 0))

        low, high = dr.minimum(dr.min(values), empty), dr.maximum(dr.max(values), empty)
        step = dr.maximum(high - low, 1e-6) / 0xFFFF
        dr.make_opaque(low, step)
        lane = dr.arange(uint, len(places) * WORDS)
        x, y, z = lane % SIDE, lane // SIDE % (SIDE + 1), lane // LAYER % (SIDE + 1)
        brick = lane // WORDS
        near, far = (uint(dr.round((value(brick, x + o, y, z) - low) / step)) for o in (0, 1))
        result = copy.copy(content)
        result.words, result.low, result.step = dr.select(brick > 0, near | far << 16, 0), [low], [step]
        dr.eval(result.words)
        bits = self._octants(len(places), value, least).numpy().reshape(-1, 8) @ (1 << np.arange(8))
        unmarked = index & np.uint32(~(0xFF << OCTANTS) & 0xFFFFFFFF)
        result.index = words(unmarked | np.where(number > 0, bits[number], 0).astype(np.uint32) << OCTANTS, self._dj)
        return result

    def _octants(self, count: int, value: Array, least: float) -> UInt32:
        """Return 1 for each octant of each brick that interpolates a voxel with matter."""
        uint, edge = self._dj.UInt32, SIDE // 2 + 1
        lane, bound = dr.arange(uint, 8 * count), dr.opaque(self._dj.Float, least)
        brick = lane // 8
        first = [(lane >> k & 1) * (SIDE // 2) for k in range(3)]

        def body(k: UInt32, dense: Mask) -> tuple[UInt32, Mask]:
            step = k % edge, k // edge % edge, k // edge**2
            voxel = value(brick, *(f + s for f, s in zip(first, step, strict=True)))
            return k + 1, dense | ((voxel > bound) & (brick > 0))

        start = dr.zeros(uint, 8 * count), dr.full(dr.mask_t(uint), False, 8 * count)
        dense = ops.while_loop(state=start, cond=lambda k, dense: k < edge**3, body=body, label="octants")[1]
        return uint(dr.select(dense, 1, 0))
