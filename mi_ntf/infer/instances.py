"""Many copies of fields as one density, with their visibility, in the coordinates of a sphere around all of them.

Kernels do not grow with the number of copies. A grid of cells lists the copies near a point; a ray towards a light
visits the copies whose spheres it meets.
"""

from collections.abc import Callable, Sequence
from types import ModuleType

import drjit as dr
import numpy as np

from ..core import spheres
from ..core.ops import dot
from . import ops
from .backend import floats, words
from .bundle import safe_inverse
from .grid import Density
from .network import NOTHING, density_of
from .shade import Reflectance
from .types import Array, Float, Mask, Place, Reflected, UInt32, Vector, Visibility
from .visibility import outside

CELLS = 8
"""Cells of the grid for each copy."""


class Copies:
    """Places of the copies of fields.

    Parameters
    ----------
    origin
        (n, 3) centres of their unit spheres, common coordinates.
    rotation
        (n, 3, 3) from their field coordinates to the common ones.
    size
        (n,) radii of their unit spheres, common units.
    field_index
        (n,) the field of each.
    dj
        Dr.Jit module of the back end.
    """

    def __init__(self, origin: np.ndarray, rotation: np.ndarray, size: np.ndarray, field_index: np.ndarray,
                 dj: ModuleType):
        self.origin, self.rotation, self.size, self.field_index, self.dj = origin, rotation, size, field_index, dj
        self._field_index = words(field_index, dj)
        self._spheres = floats(np.concatenate([origin, 1 / size[:, None]], 1), dj)
        columns = np.concatenate([np.swapaxes(rotation, 1, 2), np.zeros((len(size), 3, 1))], 2)
        self._columns = floats(columns, dj)
        self.count = dr.opaque(dj.UInt32, len(size))

    def sphere(self, i: UInt32, p: Vector) -> tuple[Vector, Float]:
        """Return points relative to the centre of copy `i`, in its field's units, and the number of these units."""
        *origin, scale = dr.gather(self.dj.Array4f, self._spheres, i)
        return tuple((a - b) * scale for a, b in zip(p, origin, strict=True)), scale

    def call(self, i: UInt32, functions: Sequence[Callable[..., Array]], *arguments: Array) -> Array:
        """Return the result of the function of the field of copy `i`."""
        if len(functions) == 1:
            return functions[0](*arguments)
        return dr.switch(dr.gather(self.dj.UInt32, self._field_index, i), list(functions), *arguments)

    def axes(self, i: UInt32) -> list[Vector]:
        """Return the axes of copy `i` in common coordinates."""
        return [tuple(dr.gather(self.dj.Array4f, self._columns, 3 * i + k))[:3] for k in range(3)]


def into(axes: list[Vector], v: Vector) -> tuple[Float, ...]:
    """Return vectors of common coordinates along `axes`."""
    return tuple(dot(axis, v) for axis in axes)


def out_of(axes: list[Vector], v: Vector) -> tuple[Float, ...]:
    """Return vectors along `axes` in common coordinates."""
    return tuple(sum((c * axis[k] for c, axis in zip(v, axes, strict=True)), 0.0 * v[0]) for k in range(3))


class _Grid:
    """Grid of cells over the box of all spheres, each with the copies whose spheres reach it."""

    def __init__(self, copies: Copies):
        origin, size, dj = copies.origin, copies.size[:, None], copies.dj
        low, high = (origin - size).min(0), (origin + size).max(0)
        side = (np.prod(high - low) / (CELLS * len(size))) ** (1 / 3)
        counts = np.maximum(np.ceil((high - low) / side), 1).astype(int)
        cell = (high - low) / counts
        corner = low + cell * np.stack(np.meshgrid(*map(np.arange, counts[::-1]), indexing="ij"), -1).reshape(-1, 3)[
            :, ::-1]
        lists = []
        for at in corner:
            nearest = np.clip(origin, at, at + cell)
            lists.append(np.flatnonzero(((nearest - origin) ** 2).sum(1) <= (1.001 * size[:, 0]) ** 2))
        self.low, self.high, self.dj = low, high, dj
        self._list = words(np.concatenate([*lists, [0]]), dj)
        self._starts = words(np.cumsum([0, *map(len, lists)]), dj)
        self._low, self._inverse, self._cell, self._last = (
            [dr.opaque(dj.Float, float(v)) for v in row] for row in (low, 1 / cell, cell, counts - 1))
        self._rows = dr.opaque(dj.UInt32, int(counts[0])), dr.opaque(dj.UInt32, int(counts[0] * counts[1]))

    def cell(self, p: Vector) -> list[Float]:
        """Return the number of the cell at `p` along each axis."""
        return [dr.floor(ops.fmin(ops.fmax((c - low) * inverse, 0), last))
                for c, low, inverse, last in zip(p, self._low, self._inverse, self._last, strict=True)]

    def members(self, cell: list[Float]) -> tuple[UInt32, UInt32]:
        """Return begin and end of the list of a cell."""
        x, y, z = (self.dj.UInt32(c) for c in cell)
        number = x + y * self._rows[0] + z * self._rows[1]
        return tuple(dr.gather(self.dj.UInt32, self._starts, number + k) for k in range(2))

    def copy(self, k: UInt32) -> UInt32:
        """Return the copy at place `k` of the lists."""
        return dr.gather(self.dj.UInt32, self._list, k)

    def way_out(self, p: Vector, cell: list[Float], inverse: Vector) -> Float:
        """Return the distance from `p` to the face where a ray leaves its `cell`."""
        way: Float = dr.inf
        for c, number, low, size, i in zip(p, cell, self._low, self._cell, inverse, strict=True):
            face = low + (number + dr.select(i > 0, self.dj.Float(1), 0)) * size
            way = dr.minimum(way, (face - c) * i)
        return dr.maximum(way, 0)


def _log_density(field: Density) -> Callable[[Vector], Float]:
    return lambda x: field.log_density(field.place(x))


def _clear_distance(field: Density) -> Callable[[Vector, Vector], Float]:
    return lambda x, inverse: field.clear_distance(field.place(x), inverse)


def _wide(reflect: Callable[[Vector], Reflectance]) -> Callable[[Vector], tuple[Vector | Float | None, ...]]:
    """Return `reflect` of surfaces as a function of tuples, with the numbers of whole fields for each point."""

    def values(x: Vector) -> tuple[Vector | Float | None, ...]:
        r = reflect(x)
        return *r[:5], *(None if v is None else v + 0 * r.roughness for v in (r.retro, r.tail))

    return values


class Instances:
    """The sum of the densities of `copies` of `fields`, a :class:`mi_ntf.infer.grid.Density`.

    `reflect`: reflectance of points, one function for each field. Fields that differ must be surfaces of one kind.
    """

    def __init__(self, fields: Sequence[Density], copies: Copies, reflect: Sequence[Callable[[Vector], Reflectance]]):
        self.copies, self._reflect, self._dj = copies, reflect, copies.dj
        self._grid = _Grid(copies)
        self.resolution, self.bounds = max(f.resolution for f in fields), (self._grid.low, self._grid.high)
        self.majorant = float(sum(fields[k].majorant / s for k, s in zip(copies.field_index, copies.size, strict=True)))
        self.hull = np.concatenate([o + s * fields[k].hull @ r.T for o, r, s, k in zip(
            copies.origin, copies.rotation, copies.size, copies.field_index, strict=True)])
        self._logs = [_log_density(f) for f in fields]
        self._clear = [_clear_distance(f) for f in fields]

    def place(self, p: Vector) -> Place:
        """Return the points, their cells, and the begin and end of the cells' lists."""
        cell = self._grid.cell(p)
        return tuple(p), tuple(cell), *self._grid.members(cell)

    def _density_of(self, i: UInt32, p: Vector) -> Float:
        """Return σ of copy `i` at `p`, common units."""
        q, scale = self.copies.sphere(i, p)

        def look(q: Vector, scale: Float, i: UInt32) -> Float:
            x = into(self.copies.axes(i), q)
            return density_of(self.copies.call(i, self._logs, x)) * scale

        return ops.if_stmt((q, scale, i), dot(q, q) < 1, look, lambda q, scale, i: type(scale)(0), label="copy")

    def density(self, p: Vector) -> Float:
        """Return σ at `p`."""
        return density_of(self.log_density(self.place(p)))

    def log_density(self, place: Place) -> Float:
        """Return ln σ at a place, ``NOTHING`` where there is none."""
        p, _, first, end = place

        def body(k: UInt32, total: Float, p: Vector, end: UInt32) -> tuple[Array, ...]:
            return k + 1, total + self._density_of(self._grid.copy(k), p), p, end

        zero = dr.zeros(type(p[0]), dr.width(p[0]))
        total = ops.while_loop(state=(first, zero, tuple(p), end), cond=lambda k, total, p, end: k < end, body=body,
                               label="copies")[1]
        return dr.select(total > 0, dr.log(total), NOTHING)

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance that a ray runs clear of all copies of a cell, as far as the cell."""
        p, cell, first, end = place
        d = tuple(dr.rcp(c) for c in inverse_d)

        def clear(q: Vector, d: Vector, scale: Float, i: UInt32) -> Float:
            axes = self.copies.axes(i)
            return self.copies.call(i, self._clear, into(axes, q), safe_inverse(into(axes, d))) / scale

        def enter(q: Vector, d: Vector, scale: Float, i: UInt32) -> Float:
            hit, _, h = spheres.chord(ops, q, d)
            way = -spheres.coordinate(q, d) - h
            return dr.select(hit & (way >= 0), way / scale, dr.inf)

        def body(k: UInt32, skip: Float, p: Vector, d: Vector, end: UInt32) -> tuple[Array, ...]:
            i = self._grid.copy(k)
            q, scale = self.copies.sphere(i, p)
            one = ops.if_stmt((q, d, scale, i), dot(q, q) < 1, clear, enter, label="clear of a copy")
            return k + 1, dr.minimum(skip, one), p, d, end

        state = first, self._grid.way_out(p, cell, inverse_d), tuple(p), d, end
        return ops.while_loop(state=state, cond=lambda k, skip, p, d, end: (k < end) & (skip > 0), body=body,
                              label="clear of copies")[1]

    def extent(self, m: Vector, d: Vector, h: Float) -> tuple[Float, Float]:
        """Return begin and end, t', of the part of a chord in the box of all copies."""
        near, far = -h, h
        for mi, inverse, low, high in zip(m, safe_inverse(d), *self.bounds, strict=True):
            a, b = ((dr.opaque(self._dj.Float, float(v)) - mi) * inverse for v in (low, high))
            near, far = dr.maximum(near, dr.minimum(a, b)), dr.minimum(far, dr.maximum(a, b))
        return near, far

    def reflectance(self, p: Vector) -> Reflected:
        """Return normal, albedo, roughness and specular weight at `p`."""
        r = self.reflect(p)
        return r.normal, r.albedo, r.roughness, r.specular

    def reflect(self, p: Vector) -> Reflectance:
        """Return the reflectance of one copy at `p`, chosen at random by density where copies overlap."""
        i = self._choose(p)
        q, _ = self.copies.sphere(i, p)
        axes = self.copies.axes(i)
        x = into(axes, q)
        if len(self._reflect) == 1:
            result = self._reflect[0](x)
        else:
            result = Reflectance(*self.copies.call(i, [_wide(reflect) for reflect in self._reflect], x))
        return result._replace(normal=out_of(axes, result.normal))

    def _choose(self, p: Vector) -> UInt32:
        """Return a copy at each point, with a probability in proportion to its density."""
        _, _, first, end = self.place(p)
        u = _uniform(self._dj, p)

        def body(k: UInt32, u: Float, total: Float, chosen: UInt32, p: Vector, end: UInt32) -> tuple[Array, ...]:
            i = self._grid.copy(k)
            sigma = self._density_of(i, p)
            total = total + sigma
            chance = dr.select(sigma > 0, sigma / total, 0)
            take = u < chance
            u = dr.select(take, u / dr.maximum(chance, 1e-30), (u - chance) / dr.maximum(1 - chance, 1e-6))
            return k + 1, u, total, dr.select(take, i, chosen), p, end

        zero = dr.zeros(type(u), dr.width(u))
        chosen = self._grid.copy(dr.minimum(first, end - dr.select(end > first, self._dj.UInt32(1), 0)))
        return ops.while_loop(state=(first, u, zero, chosen, tuple(p), end), body=body, label="choice of a copy",
                              cond=lambda k, u, total, chosen, p, end: k < end)[3]


class InstancedVisibility:
    """The product of the transmittances of all copies, each by the visibility method of its field."""

    def __init__(self, methods: Sequence[Visibility], copies: Copies):
        self.methods, self.copies = methods, copies

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the product."""
        copies, dj = self.copies, self.copies.dj

        def of(method: Visibility) -> Callable[..., Array]:
            return lambda x, wi, distance: outside.tau(method, x, wi, distance, index, True, sun)

        lookups = [of(method) for method in self.methods]

        def through(q: Vector, wi: Vector, distance: Float, i: UInt32, tau: Float) -> Float:
            axes = copies.axes(i)
            return tau * copies.call(i, lookups, into(axes, q), into(axes, wi), distance)

        def beside(q: Vector, wi: Vector, distance: Float, i: UInt32, tau: Float) -> Float:
            return tau

        def body(i: UInt32, tau: Float, active: Mask) -> tuple[Array, ...]:
            q, scale = copies.sphere(i, x)
            b = dot(q, wi)
            miss = tuple(a - b * c for a, c in zip(q, wi, strict=True))
            meets = (dot(miss, miss) < 1) & ((b < 0) | (dot(q, q) < 1))
            tau = ops.if_stmt((q, tuple(wi), distance * scale, i, tau), active & meets, through, beside, label="copy")
            return i + 1, tau, active & (i + 1 < copies.count) & (tau > 0)

        n = max(dr.width(x[0]), dr.width(wi[0]))
        state = dr.zeros(dj.UInt32, n), dr.ones(dj.Float, n), dj.Bool(active)
        return ops.while_loop(state=state, cond=lambda i, tau, active: active, body=body, label="copies on the way")[1]


def _uniform(dj: ModuleType, p: Vector) -> Float:
    """Return a number in [0, 1), a function of the bits of a point."""
    state = dj.UInt32(0x9E3779B9)
    for c, factor in zip(p, (0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F), strict=True):
        word: Array = dr.reinterpret_array(dj.UInt32, c)
        state = (state ^ (word * factor)) * 0x2C1B3C6D
        state ^= state >> 15
    state *= 0x297A2D39
    return dj.Float((state ^ (state >> 16)) >> 8) * 2.0**-24
