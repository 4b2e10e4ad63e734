"""Marches through the field along camera rays: the points that they shade, and free flight.

They skip empty space by the grid's clearance: inside the empty cube around a cell, no step has density. Positions stay
on one lattice per ray, so that skipping changes no value.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ..core import spheres
from . import ops
from .grid import CELLS

MIN_WEIGHT_RATE = 0.02
"""Samples that weigh less than this times their cell's length are not shaded: matter that would add less than 2 % of a
pixel per unit-sphere radius of depth. It is the tail of nearly spent rays, and the faint rim of a skin."""
MIN_TRANSMITTANCE = 1e-3
"""Camera rays end here; what lies behind could add 0.1 %."""


def clear_distance(grid, p, inverse_d):
    """How far a ray from `p` runs before it leaves the empty cube around `p`; 0 in an occupied cell.

    `inverse_d`: componentwise 1/direction (finite). In field units.
    """
    uint = dr.uint32_array_t(type(p[0]))
    cell = [dr.clip(dr.floor(c * (CELLS / 2) + CELLS / 2), 0, CELLS - 1) for c in p]
    n = dr.gather(type(p[0]), grid.clearance, (uint(cell[2]) * CELLS + uint(cell[1])) * CELLS + uint(cell[0]))
    exits = []
    for c, k, inv in zip(p, cell, inverse_d, strict=True):
        face = dr.select(inv > 0, k + n, k - n + 1) * (2 / CELLS) - 1
        exits.append((face - c) * inv)
    exit_ = dr.minimum(dr.minimum(exits[0], exits[1]), exits[2])
    return dr.select(n > 0, dr.maximum(exit_, 0), 0)


def safe_inverse(d):
    """1/d by components, ±1e8 where a component is 0."""
    return tuple(dr.rcp(dr.select(dr.abs(c) < 1e-8, dr.select(c < 0, -1e-8, 1e-8), c)) for c in d)


@dataclass(frozen=True)
class Strand:
    """A ray in the coordinates of one field that it may cross.

    density  callable, field density at a point
    grid     whose empty space is skipped
    o, d     origin and unit direction, 3-tuples, field coordinates
    step     length of the march's cells, field units
    rate     field units per unit of the ray's parameter t; None: t is in these field units (a ray of one strand)
    """

    density: Callable
    grid: object
    o: tuple
    d: tuple
    step: object
    rate: object = None


class Bundle:
    """A ray with its strands through all fields: where densities overlap, they add.

    Inside a bundle t counts from `base`, where the ray enters the first of their spheres: cameras and lights may be
    10⁴ radii away, where float32 tells no two cells apart. Cells are as long as the finest field asks whose sphere
    they lie in, and begin `offset` of a cell's length before it.

    base      where t = 0 lies on the ray
    end       where it leaves the last sphere, or ends
    strands   with origins at t = 0
    """

    def __init__(self, strands, maxt, offset):
        self.single = len(strands) == 1
        self.active, self.base = False, dr.inf
        chords = []
        for s in strands:
            rate = 1 if s.rate is None else s.rate
            hit, m, h = spheres.chord(ops, s.o, s.d)
            # From the middle of the chord, which keeps its digits where the origin is far.
            middle = spheres.coordinate(tuple(a - b for a, b in zip(m, s.o, strict=True)), s.d)
            enter = dr.maximum(-h, -middle)
            hit = hit & (h > enter) & ((middle + enter) < maxt * rate)
            self.active = hit | self.active
            self.base = dr.minimum(self.base, dr.select(hit, (middle + enter) / rate, dr.inf))
            chords.append((hit, m, h, middle, enter, rate))
        self.base = dr.select(self.active, self.base, 0)
        self.strands, self.intervals, self.cells, self.begins = [], [], [], []
        self.end = dr.zeros(type(self.base), dr.width(self.base))
        for s, (hit, m, h, middle, enter, rate) in zip(strands, chords, strict=True):
            # t' of t = 0, without a difference of large numbers where there is one strand.
            at = enter if self.single else dr.select(hit, self.base * rate - middle, 0)
            origin = tuple(a + at * b for a, b in zip(m, s.d, strict=True))
            self.strands.append(replace(s, o=origin))
            begin, end = (enter - at) / rate, dr.minimum((h - at) / rate, maxt - self.base)
            self.intervals.append((dr.select(hit, begin, dr.inf), dr.select(hit, end, -dr.inf)))
            self.end = dr.select(hit, dr.maximum(self.end, end), self.end)
            self.cells.append(s.step / rate)
            self.begins.append(dr.select(hit, begin - offset * self.cells[-1], dr.inf))
        self.begin = self.begins[0]
        for other in self.begins[1:]:
            self.begin = dr.minimum(self.begin, other)
        self.begin = dr.select(self.active, self.begin, 0)
        self.inverse = [safe_inverse(s.d) for s in strands]

    def step(self, t):
        """Length of the cell that begins at `t`: the finest field's here, up to where a finer one's cells begin."""
        if self.single:
            return self.cells[0]
        length = dr.inf
        for (_, end), cell, begin in zip(self.intervals, self.cells, self.begins, strict=True):
            ahead = dr.maximum(begin - t, cell)
            length = dr.minimum(length, dr.select(t < end, dr.select(t < begin, ahead, cell), dr.inf))
        return dr.select(length < dr.inf, length, self.cells[0])

    def cell(self, t, step):
        """Begin and length of the cell at `t`, cut off where the ray begins and ends (a surface may be there)."""
        begin = dr.maximum(t, 0)
        return begin, dr.minimum(t + step, self.end) - begin

    def point(self, i: int, t):
        """The point at `t` in the coordinates of field `i`."""
        s = self.strands[i]
        along = t if s.rate is None else t * s.rate
        return tuple(a + along * b for a, b in zip(s.o, s.d, strict=True))

    def at(self, t, active):
        """``(skip, sigmas)``: how far the ray is clear of all matter from `t` on, 0 in an occupied cell; each field's
        density there, per unit of t."""
        skips, places = [], []
        for i, (s, inverse, (begin, end)) in enumerate(zip(self.strands, self.inverse, self.intervals, strict=True)):
            p = self.point(i, t)
            skip = clear_distance(s.grid, p, inverse)
            if not self.single:
                inside, ahead = (t >= begin) & (t < end), dr.maximum(self.end - t, 1e-6)
                skip = dr.select(inside, skip / s.rate, dr.select(t < begin, dr.minimum(begin - t, ahead), ahead))
            skips.append(skip)
            places.append(p)
        sigmas = [
            dr.select(active & (skip <= 0), s.density(p), 0) * (1 if s.rate is None else s.rate)
            for s, skip, p in zip(self.strands, skips, places, strict=True)
        ]
        skip = skips[0]
        for other in skips[1:]:
            skip = dr.minimum(skip, other)
        return skip, sigmas

    def counts(self, shares, step):
        """Whether a sample of these weights is worth shading: that of some field, in its own unit."""
        hit = False
        for s, share in zip(self.strands, shares, strict=True):
            hit = (share > MIN_WEIGHT_RATE * step * (1 if s.rate is None else s.rate)) | hit
        return hit


@dataclass(frozen=True)
class Samples:
    """Shading points of camera rays, those of one ray side by side, as it meets them.

    ray            index of each point's ray
    t              its place, from where its bundle begins (`bundle`)
    weights        its weight in each field, one array a field; their sum is w
    view           transmittance from the camera to the very point, or None
    transmittance  per ray: of the whole ray
    first, count   per ray: where its points begin, and how many they are
    """

    bundle: Bundle
    ray: object
    t: object
    weights: tuple
    view: object
    transmittance: object
    first: object
    count: object

    def line(self, i: int, ray):
        """``(o, d)`` of the rays `ray` in the coordinates of field `i`."""
        s = self.bundle.strands[i]
        return tuple(tuple(dr.gather(type(c), c, ray) for c in v) for v in (s.o, s.d))

    def along(self, i: int, line, t):
        """The points at `t` of such a `line`."""
        rate = self.bundle.strands[i].rate
        t = t if rate is None else t * rate
        return tuple(a + t * b for a, b in zip(*line, strict=True))

    def place(self, i: int, ray, t):
        """``(x, d)``: points at `t` of the rays `ray`, and the rays' directions, in the coordinates of field `i`."""
        line = self.line(i, ray)
        return self.along(i, line, t), line[1]

    def totals(self, values: list, gradients: bool = False) -> list:
        """Σ over each ray's points of each of `values`, per ray: in one order, unlike atomic sums. `gradients`: the
        values are attached."""
        count = self.count

        def body(k, sums):
            return k + 1, [s + dr.gather(type(s), v, self.first + k, k < count)
                           for s, v in zip(sums, values, strict=True)]  # fmt: skip

        n = dr.width(count)
        return dr.while_loop(
            state=(dr.zeros(type(count), n), [dr.zeros(type(self.t), n) for _ in values]),
            cond=lambda k, sums: k < count,
            body=body,
            label="samples of a ray",
            max_iterations=-1 if gradients else None,  # a sum
        )[1]


def camera_samples(strands, maxt, offset, depth, shade=True, view=False) -> Samples:
    """Shading points of camera rays, compacted.

    strands   of each ray, one for each field
    maxt      where each ray ends (a surface, or infinity)
    offset    per ray, uniform in [0, 1): where its lattice of cells begins
    depth     per ray, uniform in [0, 1): where in its cell a sample lies, as a quantile of the light lost in that cell
    shade     whether there is use for the samples; otherwise only `transmittance` is found
    view      whether `view` is wanted

    Quadrature of method.md, section 1: α_j = 1 − e^(−σ_j Δ), w_j = T_j α_j, σ_j at the middle of cell j, the sum over
    the fields. The sample lies where free flight through the cell's constant σ_j would end, so that quantities that
    vary within a cell, above all the light's own transmittance, are averaged with the right weights: the expectation
    over `depth` is exact for constant σ_j. Up to that point the cell lets 1 − depth·α_j through.

    Samples that weigh at most MIN_WEIGHT_RATE times their cell's length in every field are left out.
    """
    # First walk: count. Second: write. Costs little beside shading and needs no guess of the capacity.
    bundle = Bundle(strands, maxt, offset)
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))
    rays = dr.arange(uint, dr.width(bundle.base))

    def tally(hit, sample, state):
        return (state[0] + dr.select(hit, uint(1), 0),)

    transmittance, (count,) = _walk(bundle, offset, depth, tally, (dr.zeros(uint, dr.width(rays)),))
    total, start = 0, dr.zeros(uint, dr.width(rays))
    if shade:
        start = dr.prefix_sum(count)
        total = int(dr.sum(count)[0])
    out = dr.zeros(uint, total), *(dr.zeros(floats, total) for _ in range(1 + len(strands) + view))
    if total:
        end = start + count

        def write(hit, sample, state):
            slot, *targets = state
            # The two walks are two kernels, which a compiler may round differently: a sample that only this one finds
            # has no slot.
            hit = hit & (slot < end)
            for target, value in zip(targets, (rays, *sample[: len(targets) - 1]), strict=True):
                dr.scatter(target, value, slot, hit)
            return slot + dr.select(hit, uint(1), 0), *targets

        _, (_, *out) = _walk(bundle, offset, depth, write, (uint(start), *out))
        dr.eval(out, transmittance, start, count)
    weights = tuple(out[2 : 2 + len(strands)])
    return Samples(bundle, out[0], out[1], weights, out[-1] if view else None, transmittance, start, count)


def camera_light(strands, maxt, offset, depth, reflect):
    """The light of camera rays whose lights all shine from the camera, in one walk: the view's transmittance is theirs.

    Arguments as :func:`camera_samples`; ``reflect(i, x, view)``: radiance, a 3-tuple, that the point `x` of strand
    `i`, `view` of whose light gets to the camera, reflects. Returns ``(radiance, transmittance)`` per ray.
    """
    bundle = Bundle(strands, maxt, offset)

    def shade(t, shares, view, *light):
        for i, share in enumerate(shares):
            light = [c + share * v for c, v in zip(light, reflect(i, bundle.point(i, t), view), strict=True)]
        return tuple(light)

    def add(hit, sample, state):
        t, *shares, view = sample
        # Few cells hold samples that count: the branch skips what the others would cost.
        return dr.if_stmt((t, shares, view, *state), hit, shade, lambda t, shares, view, *light: light, label="shade")

    zero = dr.zeros(type(bundle.base), dr.width(bundle.base))
    transmittance, light = _walk(bundle, offset, depth, add, (zero, type(zero)(zero), type(zero)(zero)))
    return light, transmittance


def _walk(bundle, offset, depth, emit, state):
    """One walk along the camera rays of `bundle`; ``emit(hit, sample, state)`` gives the next state and is called for
    each cell, `hit` where it holds a sample that counts: t, the weight in each field, and the view's transmittance.
    Returns ``(transmittance, state)``."""
    floats = type(bundle.base)

    def body(t, transmittance, state, active):
        step = bundle.step(t)
        begin, length = bundle.cell(t, step)
        skip, sigmas = bundle.at(begin + 0.5 * length, active)
        sigma = sum(sigmas[1:], sigmas[0])
        alpha = 1 - dr.exp(-sigma * length)
        w = transmittance * alpha
        lost = depth * alpha
        rate = dr.rcp(dr.maximum(sigma, 1e-6))
        shares = (w,) if bundle.single else tuple(w * s * rate for s in sigmas)
        sample = begin - dr.log(1 - lost) * rate, *shares, transmittance * (1 - lost)
        state = emit(active & bundle.counts(shares, step), sample, state)
        transmittance = dr.select(active, transmittance - w, transmittance)
        t = t + onward(skip, step)
        active = active & (t < bundle.end) & (transmittance > MIN_TRANSMITTANCE)
        return t, transmittance, state, active

    _, transmittance, state, _ = dr.while_loop(
        state=(floats(bundle.begin), dr.ones(floats, dr.width(bundle.base)), state, bundle.active),
        cond=lambda t, transmittance, state, active: active,
        body=body,
        label="camera march",
    )
    return dr.select(transmittance > MIN_TRANSMITTANCE, transmittance, 0), state


def onward(skip, step):
    """From one cell to the next, or beyond all whose middles are as `skip` says clear: whole cells, so that skipping
    changes no other cell."""
    return dr.select(skip > 0, step * (dr.floor(skip / step) + 1), step)


def free_flight(strands, maxt, offset, depth, which):
    """Where rays end in the fields if they pass the optical depth `depth` (for free flight −ln(1 − u)).

    Arguments as :func:`camera_samples`; `which`, uniform in [0, 1), says whose matter it is where several overlap.
    Returns ``(hit, t, index, bundle)``: whether a ray ends before `maxt`, where (t of `bundle`), and the strand's
    index. Linear depth within cells.
    """
    bundle = Bundle(strands, maxt, offset)
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))

    def body(t, passed, end, index, active):
        step = bundle.step(t)
        begin, length = bundle.cell(t, step)
        skip, sigmas = bundle.at(begin + 0.5 * length, active)
        sigma = sum(sigmas[1:], sigmas[0])
        after = passed + sigma * length
        hit = active & (after >= depth) & (sigma > 0)
        end = dr.select(hit, begin + (depth - passed) / dr.maximum(sigma, 1e-6), end)
        rest = which * sigma
        for sigma_i in sigmas[:-1]:
            rest = rest - sigma_i
            index = dr.select(hit & (rest >= 0), index + 1, index)
        t = t + onward(skip, step)
        active = active & ~hit & (t < bundle.end)
        return t, after, end, index, active

    n = dr.width(bundle.base)
    begin = floats(bundle.begin)
    state = (begin, dr.zeros(floats, n), dr.full(floats, dr.inf, n), dr.zeros(uint, n), bundle.active)
    _, _, t, index, _ = dr.while_loop(
        state=state, cond=lambda t, passed, end, index, active: active, body=body, label="free flight"
    )
    return dr.isfinite(t), t, index, bundle
