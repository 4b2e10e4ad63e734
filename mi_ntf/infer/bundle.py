"""Rays through one or several fields, in cells of a march.

Marches skip empty space by the volume's bricks. Positions stay on one lattice per ray, so that skipping changes no
value.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import drjit as dr

from ..core import spheres
from . import ops
from .grid import Density
from .network import NOTHING, density_of
from .tuning import PIECES
from .types import Array, Float, Mask, Place, Vector

STEEP = 1.594
"""Largest difference of ln σ at a piece's ends. It solves (1 − e^−x)/x = ½, so the mean of a steeper piece is half of
the higher density, which is right on average where density sets in at once."""
INSET = 0.001
"""Distance before the end of a piece, in pieces, at which densities are evaluated: inside the sphere where a ray leaves
it."""


def density_where(active: Mask, volume: Density, place: Place) -> Float:
    """Return the density of `volume` at its `place` where `active`, 0 elsewhere.

    Packets of rays without matter skip the fetches.
    """
    floats: Array = dr.float32_array_t(type(active))
    return ops.if_stmt((place,), active, lambda place: density_of(volume.log_density(place)), lambda place: floats(0),
                      label="density")


def slope_where(active: Mask, density: Callable[[Vector], Float], p: Vector) -> tuple[Float, Float, Float, Float]:
    """Return ``(σ, ∂σ/∂x, ∂σ/∂y, ∂σ/∂z)`` at `p` where `active`, 0 elsewhere."""

    def slope(*p: Float) -> tuple[Array, ...]:
        with ops.isolate_grad(), ops.resume_grad():
            q = dr.detach(p)
            dr.enable_grad(q)
            sigma = density(q)
            dr.backward(sigma)
            return (dr.detach(sigma), *dr.grad(q))

    def none(*p: Float) -> tuple[Array, ...]:
        return (type(p[0])(0),) * 4

    sigma, x, y, z = ops.if_stmt((*p,), active, slope, none, label="slope")
    return sigma, x, y, z


def safe_inverse(d: Vector) -> tuple[Float, ...]:
    """Return 1/d by components, ±1e8 where a component is 0."""
    return tuple(dr.rcp(dr.select(ops.abs(c) < 1e-8, dr.select(c < 0, -1e-8, 1e-8), c)) for c in d)


@dataclass(frozen=True)
class Strand:
    """A ray of origin `o` and unit direction `d` in the coordinates of one field that it may cross."""

    volume: Density
    o: Vector
    d: Vector
    step: Float
    """Length of the march's cells, field units."""
    rate: Float | None = None
    """Field units per unit of the ray's parameter t; None: t is in these field units (a ray of one strand)."""


class Bundle:
    """Rays with their strands through all fields, whose densities add where they overlap.

    Inside a bundle t counts from `base`, the place on the ray where it enters the first field's extent, which is its
    sphere or a body within: cameras and lights may be 10⁴ radii away, where float32 cannot resolve cells. Cells have
    the length of the finest field in whose extent they lie, and begin `offset` of a cell's length before it. At `end`
    the ray leaves the last extent, or ends at `maxt`. The `strands` of a bundle have their origins at t = 0.
    """

    def __init__(self, strands: Sequence[Strand], maxt: Float, offset: Float):
        self.single = len(strands) == 1
        self.active: Mask = False
        self.base: Float = dr.inf
        chords = []
        for s in strands:
            rate = 1 if s.rate is None else s.rate
            hit, m, h = spheres.chord(ops, s.o, s.d)
            # From the middle of the chord, which keeps its digits where the origin is far.
            middle = spheres.coordinate(tuple(a - b for a, b in zip(m, s.o, strict=True)), s.d)
            first, last = s.volume.extent(m, s.d, h)
            enter = dr.maximum(first, -middle)
            hit = hit & (last > enter) & ((middle + enter) < maxt * rate)
            self.active = hit | self.active
            self.base = dr.minimum(self.base, dr.select(hit, (middle + enter) / rate, dr.inf))
            chords.append((hit, m, last, middle, enter, rate))
        self.base = dr.select(self.active, self.base, 0)
        self.strands: list[Strand] = []
        self.intervals: list[tuple[Float, Float]] = []
        self.cells: list[Float] = []
        self.begins: list[Float] = []
        self.end: Float = dr.zeros(type(self.base), dr.width(self.base))
        for s, (hit, m, last, middle, enter, rate) in zip(strands, chords, strict=True):
            # t' of t = 0, without a difference of large numbers where there is one strand.
            at = enter if self.single else dr.select(hit, self.base * rate - middle, 0)
            origin = tuple(a + at * b for a, b in zip(m, s.d, strict=True))
            self.strands.append(replace(s, o=origin))
            begin, end = (enter - at) / rate, dr.minimum((last - at) / rate, maxt - self.base)
            self.intervals.append((dr.select(hit, begin, dr.inf), dr.select(hit, end, -dr.inf)))
            self.end = dr.select(hit, dr.maximum(self.end, end), self.end)
            self.cells.append(s.step / rate)
            self.begins.append(dr.select(hit, begin - offset * self.cells[-1], dr.inf))
        self.begin = dr.select(self.active, reduce(dr.minimum, self.begins), 0)
        self.inverse = [safe_inverse(s.d) for s in strands]

    def step(self, t: Float) -> Float:
        """Return the length of the cell at `t`: the finest field's there, up to where cells of a finer one begin."""
        if self.single:
            return self.cells[0]
        length: Float = dr.inf
        for (_, end), cell, begin in zip(self.intervals, self.cells, self.begins, strict=True):
            ahead = dr.maximum(begin - t, cell)
            length = dr.minimum(length, dr.select(t < end, dr.select(t < begin, ahead, cell), dr.inf))
        return dr.select(length < dr.inf, length, self.cells[0])

    def first(self) -> tuple[Float, ...]:
        """Return ln σ of each field where the rays begin, for their first :meth:`cell`."""
        return tuple(self.logs(INSET / PIECES * self.step(dr.zeros(type(self.base), dr.width(self.base)))))

    def cell(self, t: Float, step: Float, active: Mask, before: tuple[Float, ...]) -> "Cell":
        """Return the cell at `t`, clipped to the ray; `before`: ln σ of each field there, from the previous cell."""
        begin = dr.maximum(t, 0)
        # Rounding may end the first cell before the ray begins.
        part = dr.maximum(dr.minimum(t + step, self.end) - begin, 0) * (1 / PIECES)
        skip = reduce(dr.minimum, self.clear(begin))
        count = len(self.strands)

        def look(begin: Float, part: Float, *before: Float) -> tuple[Array, ...]:
            knots = [before, *(self.logs(begin + (k + 1 - INSET) * part) for k in range(PIECES))]
            fields = [_pieces(logs) for logs in zip(*knots, strict=True)]
            sigmas = [sigmas[k] for k in range(PIECES) for sigmas, _ in fields]
            return *sigmas, *(fields[0] if self.single else _pieces([_log_sum(knot) for knot in knots]))[1], *knots[-1]

        def nothing(begin: Float, part: Float, *before: Float) -> tuple[Array, ...]:
            zero = type(begin)(0)
            return (*(zero,) * (PIECES * count + PIECES), *(type(begin)(NOTHING),) * count)

        matter = (skip <= PIECES * part) | (reduce(dr.maximum, before) > NOTHING)
        values = ops.if_stmt((begin, part, *before), active & matter, look, nothing, label="cell")
        sigmas = tuple(tuple(values[k : k + count]) for k in range(0, PIECES * count, count))
        return Cell(begin, part, sigmas, tuple(values[PIECES * count : -count]), skip, tuple(values[-count:]))

    def point(self, i: int, t: Float) -> tuple[Float, ...]:
        """Return the point at `t` in the coordinates of field `i`."""
        s = self.strands[i]
        along = t if s.rate is None else t * s.rate
        return tuple(a + along * b for a, b in zip(s.o, s.d, strict=True))

    def clear(self, t: Float) -> list[Float]:
        """Return the distance from `t` that the ray is clear of each field's matter; 0 in an occupied cell."""
        skips = []
        for i, (s, inverse, (begin, end)) in enumerate(zip(self.strands, self.inverse, self.intervals, strict=True)):
            skip = s.volume.clear_distance(s.volume.place(self.point(i, t)), inverse)
            if s.rate is not None:
                skip = skip / s.rate
            if not self.single:
                inside, ahead = (t >= begin) & (t < end), dr.maximum(self.end - t, 1e-6)
                skip = dr.select(inside, skip, dr.select(t < begin, dr.minimum(begin - t, ahead), ahead))
            skips.append(skip)
        return skips

    def logs(self, t: Float) -> list[Float]:
        """Return ln σ of each field at `t`, per unit of t."""
        logs = []
        for i, (s, (begin, end)) in enumerate(zip(self.strands, self.intervals, strict=True)):
            value = s.volume.log_density(s.volume.place(self.point(i, t)))
            if not self.single:  # a strand outside its field's sphere has no place there
                value = dr.select((t >= begin) & (t < end), value, NOTHING)
            if s.rate is not None:
                value = dr.select(value > NOTHING, value + dr.log(s.rate), NOTHING)
            logs.append(value)
        return logs


@dataclass
class Cell:
    """A cell of a ray in PIECES of equal length `part`, with densities that are exponentials across each."""

    begin: Float
    part: Float
    sigmas: tuple[tuple[Float, ...], ...]
    """Mean density of each field, for each piece."""
    bends: tuple[Float, ...]
    """Logarithm of the total density at the end of each piece over that at its begin."""
    skip: Float
    """Distance from the begin that the ray is clear of all matter."""
    after: tuple[Float, ...]
    """ln σ of each field at the end."""

    @property
    def totals(self) -> list[Float]:
        """Total density of each piece."""
        return [sum(sigmas[1:], sigmas[0]) for sigmas in self.sigmas]

    @property
    def depth(self) -> Float:
        """Optical depth of the cell."""
        totals = self.totals
        return sum(totals[1:], totals[0]) * self.part

    def place(self, depth: Float) -> Float:
        """Return the place at which the optical depth from the begin of the cell is `depth`."""
        t: Float = self.begin
        passed: Float = 0
        for sigma, bend in zip(self.totals, self.bends, strict=True):
            fraction = dr.clip((depth - passed) * dr.rcp(dr.maximum(sigma * self.part, 1e-6)), 0, 1)
            flat = fraction * (1 + 0.5 * bend * (1 - fraction))
            t = t + self.part * dr.select(dr.abs(bend) < 0.02, flat, dr.log(1 + fraction * (dr.exp(bend) - 1)) / bend)
            passed = passed + sigma * self.part
        return t

    def absorbed(self) -> list[Float]:
        """Return for each field the fraction of the light entering the cell that it absorbs."""
        passed: Float = 0
        absorbed: list[Float] = [0] * len(self.sigmas[0])
        for sigmas, sigma in zip(self.sigmas, self.totals, strict=True):
            after = passed + sigma * self.part
            rate = (dr.exp(-passed) - dr.exp(-after)) * dr.rcp(dr.maximum(sigma, 1e-6))
            absorbed = [a + rate * s for a, s in zip(absorbed, sigmas, strict=True)]
            passed = after
        return absorbed


def _pieces(logs: Sequence[Float]) -> tuple[list[Float], list[Float]]:
    """Return ``(means, bends)`` of σ in the pieces between places with these ln σ.

    The mean is that of the exponential through both ends, √(σ₀ σ₁) sinh(x)/x with x half of its bend, less a twelfth
    for the arch of a parabola through neighbouring ends.
    """
    bends = [dr.clip(b - a, -STEEP, STEEP) for a, b in itertools.pairwise(logs)]
    means = []
    for k, (bend, (a, b)) in enumerate(zip(bends, itertools.pairwise(logs), strict=True)):
        middle = min(max(k, 1), PIECES - 1)
        arch = dr.clip(bends[middle] - bends[middle - 1], -1, 1) * (1 / 12)
        top, square = dr.maximum(a, b), bend * bend
        mean = dr.exp(top - 0.5 * dr.abs(bend) - arch) * (1 + square * (1 / 24 + square * (1 / 1920)))
        means.append(dr.select(top > NOTHING, mean, 0))
    return means, bends


def _log_sum(logs: Sequence[Float]) -> Float:
    """Return ln Σ σ."""
    total: Float = sum(density_of(a) for a in logs)
    return dr.select(total > 0, dr.log(total), NOTHING)


def onward(skip: Float, step: Float, whole: int = 1) -> Float:
    """Return the distance to the next cell, or beyond all clear ones, in whole cells.

    `skip`: distance that the ray is clear from the middle of the cell; from its begin with `whole` 0.
    """
    return dr.select(skip > 0, step * dr.maximum(dr.floor(skip / step + whole), 1), step)
