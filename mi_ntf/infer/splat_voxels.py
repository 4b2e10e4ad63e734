"""Voxels of Gaussian splats: sums of Gaussians in sparse blocks of 8³ voxels.

A trilinear lookup spreads each voxel over a kernel of variance h²/6 along every axis, h being the voxel's length. The
voxels therefore sample a Gaussian whose variances are smaller by as much, so that the looked-up splat has the variances
of the true one. A splat thinner than ``THINNEST`` voxels becomes thicker instead. Its mass ∫ σ dV stays as it is, and
with it the optical depth across a surface of such splats.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

import drjit as dr
import numpy as np

from ..core.ops import Tensors
from ..core.splats import Splats
from . import bricks, ops
from .backend import floats, words
from .types import Array, Float, Mask, UInt32

BLOCK = 8
"""Voxels along an edge of a block."""
TRILINEAR = 1 / 6
"""Variance along an axis of trilinear interpolation's kernel, squared voxels."""
THINNEST = 0.5
"""Smallest standard deviation that is sampled, voxels: the voxels' sum is right to 2 e^(−2π²/4) = 1.4 %."""
FARTHEST = 5.0
"""Largest distance from its centre at which a splat has matter, standard deviations."""
FAINTEST = 0.001
"""Default optical depth across the whole volume below which the tail of a splat is cut off."""
LANES = 1 << 22
"""Number of layers that are added in one kernel, which bounds the memory."""
Kernel = Callable[[UInt32, Float, "Array", Mask], None]
"""Receives number and extinction of a splat, and the voxel (x, y, z); with a mask of the lanes that hold one."""


@dataclass(frozen=True)
class Lattice:
    """Cubic voxels: first corner `low`, length `size` of a voxel, number `counts` along each axis, x first."""

    low: np.ndarray
    size: float
    counts: np.ndarray

    @property
    def high(self) -> np.ndarray:
        """Return the last corner."""
        high: np.ndarray = self.low + self.counts * self.size
        return high

    @property
    def blocks(self) -> np.ndarray:
        """Return the number of blocks along each axis, x first."""
        blocks: np.ndarray = -(-self.counts // BLOCK)
        return blocks


class SplatSums:
    """Sums over splats at the voxels of a lattice.

    Parameters
    ----------
    splats
        The splats. Those that leave the lattice end at its sides.
    lattice
        The voxels.
    dj
        Dr.Jit module of the back end.
    thinnest
        Smallest standard deviation, voxels.
    faintest
        Optical depth across the whole volume below which the tail of a splat is cut off.
    """

    def __init__(self, splats: Splats, lattice: Lattice, dj: ModuleType, thinnest: float = THINNEST,
                 faintest: float = FAINTEST):
        self.lattice, self._dj, self.count = lattice, dj, 0
        size = lattice.size
        scales = splats.scales.astype(np.float64)
        wide = np.sqrt(np.maximum((scales / size) ** 2 - TRILINEAR, thinnest**2))
        self.peaks = splats.peaks() * np.prod(scales, 1) / np.prod(wide * size, 1)
        across = self.peaks * size * lattice.counts.max()
        reach = np.sqrt(2 * np.log(np.clip(across / faintest, 1, np.exp(FARTHEST**2 / 2))))
        axes = splats.axes()
        root = axes / wide[:, None]
        inverse = root @ np.swapaxes(root, 1, 2)
        edges = reach[:, None] * np.linalg.norm(axes * wide[:, None], axis=2)
        centres = (splats.centres - lattice.low) / size - 0.5
        self._first = np.maximum(np.ceil(centres[:, 2] - edges[:, 2]), 0).astype(np.int64)
        last = np.minimum(np.floor(centres[:, 2] + edges[:, 2]), lattice.counts[2] - 1).astype(np.int64)
        self._layers = np.where(reach > 0, np.maximum(last - self._first + 1, 0), 0)
        a = [inverse[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
        self._columns = [floats(c, dj) for c in (*centres.T, *a, self.peaks, reach)]
        self.slots = self._slots()

    def total(self, values: np.ndarray | None = None) -> np.ndarray:
        """Return Σ σ, and Σ σ · values of `values` (n, k), by the slots of blocks; slot 0 is empty.

        The result is (channels, slots, 8, 8, 8), z before y and x.
        """
        dj = self._dj
        weights = [] if values is None else [floats(v, dj) for v in values.T]
        channels = dr.opaque(dj.UInt32, 1 + len(weights))
        result = dr.zeros(dj.Float, (1 + len(weights)) * (self.count + 1) * BLOCK**3)
        slots = words(self.slots, dj)

        def add(splat: UInt32, sigma: Float, voxel: Array, active: Mask) -> None:
            x, y, z = voxel
            slot = dr.gather(dj.UInt32, slots, self._block(x, y, z), active)
            place = ((slot << 9) | ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)) * channels
            terms = [sigma, *(sigma * dr.gather(dj.Float, w, splat, active) for w in weights)]
            for k, term in enumerate(terms):
                dr.scatter_reduce(dr.ReduceOp.Add, result, term, place + k, active, mode=dr.ReduceMode.Direct)

        self._run(add, every=True)
        array: np.ndarray = np.moveaxis(result.numpy().reshape(-1, BLOCK, BLOCK, BLOCK, 1 + len(weights)), -1, 0)
        return array

    def bricks(self, channels: Sequence[np.ndarray]) -> Tensors:
        """Return the arrays of a :class:`mi_ntf.infer.bricks.Bricks` of `channels`, results of :meth:`total`.

        A brick shares voxels with the next ones, so there are also bricks that hold the first voxels of a block only.
        """
        held = np.pad(self.slots, [(0, 1)] * 3)
        corners = list(itertools.product((0, 1), repeat=3))
        sides = [n - 1 for n in held.shape]
        near = [held[tuple(slice(c, c + n) for c, n in zip(corner, sides, strict=True))] for corner in corners]
        parts = [(slice(None), *(slice(1) if c else slice(None) for c in corner)) for corner in corners]
        filled = [np.any([channel[part].any((1, 2, 3)) for channel in channels], 0) for part in parts]
        resolution = int(self.lattice.counts.max())
        places = np.argwhere(np.any([f[slot] for f, slot in zip(filled, near, strict=True)], axis=0))
        places = places[(places < bricks.bricks_per_side(resolution)).all(1)]
        values = np.zeros((len(places), len(channels)) + (BLOCK + 1,) * 3, np.float32)
        for corner, part, slot in zip(corners, parts, near, strict=True):
            to = tuple(slice(BLOCK, None) if c else slice(BLOCK) for c in corner)
            for k, channel in enumerate(channels):
                values[(slice(None), k) + to] = channel[part][slot[tuple(places.T)]]  # noqa: RUF005
        octants = np.any([bricks.octants_of(values[:, k] != 0) for k in range(len(channels))], 0)
        return bricks.pack(values, places, octants, resolution, 0.0)

    def _slots(self) -> np.ndarray:
        """Return the number of each block that holds matter, from 1 on, 0 for the others; (z, y, x) uint32."""
        marks = dr.zeros(self._dj.UInt32, int(np.prod(self.lattice.blocks)))

        def mark(splat: UInt32, sigma: Float, voxel: Array, active: Mask) -> None:
            dr.scatter(marks, self._dj.UInt32(1), self._block(*voxel), active)

        self._run(mark, every=False)
        marked = marks.numpy() > 0
        self.count = int(marked.sum())
        slots = np.zeros(len(marked), np.uint32)
        slots[marked] = np.arange(1, self.count + 1)
        return slots.reshape(self.lattice.blocks[::-1])

    def _block(self, x: UInt32, y: UInt32, z: UInt32) -> UInt32:
        bx, by, _ = (int(b) for b in self.lattice.blocks)
        return ((z >> 3) * dr.opaque(self._dj.UInt32, by) + (y >> 3)) * dr.opaque(self._dj.UInt32, bx) + (x >> 3)

    def _run(self, kernel: Kernel, every: bool) -> None:
        """Call `kernel` for all voxels of all splats; unless `every`, once in each block of each row at least."""
        ends = np.cumsum(self._layers)
        total = int(ends[-1]) if len(ends) else 0
        for begin in range(0, total, LANES):
            number = np.arange(begin, min(begin + LANES, total))
            splat = np.searchsorted(ends, number, side="right")
            layer = self._first[splat] + number - (ends[splat] - self._layers[splat])
            self._part(words(splat, self._dj), words(layer, self._dj), kernel, every)

    def _part(self, splat: UInt32, layer: UInt32, kernel: Kernel, every: bool) -> None:
        dj = self._dj
        cx, cy, cz, xx, xy, xz, yy, yz, zz, peak, reach = (dr.gather(dj.Float, c, splat) for c in self._columns)
        nx, ny = (dr.opaque(dj.Int, int(n) - 1) for n in self.lattice.counts[:2])
        z = dj.Float(layer) - cz
        # In a layer: |p|² = yy' (y − y₀)² + … after x is eliminated, then the interval of x in each row.
        yy_rest, yz_rest = yy - xy * xy / xx, yz - xy * xz / xx
        zz_rest = zz - xz * xz / xx - yz_rest * yz_rest / yy_rest
        left = reach * reach - zz_rest * z * z
        middle, half = -yz_rest / yy_rest * z, dr.safe_sqrt(left / yy_rest)
        y = dr.maximum(dj.Int(dr.ceil(cy + middle - half)), 0)
        last = dr.select(left > 0, dr.minimum(dj.Int(dr.floor(cy + middle + half)), ny), -1)

        def row(y: Array) -> tuple[Array, Array]:
            offset = dj.Float(y) - cy
            rest = left - yy_rest * dr.square(offset - middle)
            mid, wide = -(xy * offset + xz * z) / xx, dr.safe_sqrt(rest / xx)
            begin, end = dr.ceil(cx + mid - wide), dr.floor(cx + mid + wide)
            return dr.maximum(dj.Int(begin), 0), dr.minimum(dj.Int(end), nx)

        def body(y: Array, x: Array, end: Array) -> tuple[Array, Array, Array]:
            within = x <= end
            dx, dy = dj.Float(x) - cx, dj.Float(y) - cy
            power = dx * (xx * dx + 2 * (xy * dy + xz * z)) + dy * (yy * dy + 2 * yz * z) + zz * z * z
            kernel(splat, peak * dr.exp(-0.5 * power), (dj.UInt32(x), dj.UInt32(y), layer), within)
            following = x + 1 if every else dr.maximum(dr.minimum((x | 7) + 1, end), x + 1)
            first, ending = row(y + 1)
            return (dr.select(within, y, y + 1), dr.select(within, following, first), dr.select(within, end, ending))

        x, end = row(y)
        state = ops.while_loop(state=(y, x, end), cond=lambda y, x, end: y <= last, body=body, label="rows")
        dr.eval(state)
