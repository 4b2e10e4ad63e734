"""Marches through the field along camera rays: the points that they shade, and free flight.

They skip empty space by the grid's clearance: inside the empty cube around a cell, no step has density. Positions stay
on one lattice per ray, so that skipping changes no value.
"""

from collections.abc import Callable
from dataclasses import dataclass

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


def camera_interval(o, d, maxt):
    """``(active, t0, t1)``: the part of the ray o + t d, 0 ≤ t ≤ maxt, inside the unit sphere."""
    hit, m, h = spheres.chord(ops, o, d)
    tm = spheres.coordinate(tuple(a - b for a, b in zip(m, o, strict=True)), d)
    t0, t1 = dr.maximum(tm - h, 0), dr.minimum(tm + h, maxt)
    return hit & (t1 > t0), t0, t1


@dataclass(frozen=True)
class Strand:
    """A ray in the coordinates of one field that it may cross.

    density  callable, field density at a point
    grid     whose empty space is skipped
    o, d     origin and unit direction, 3-tuples, field coordinates
    rate     field units per unit of the ray's parameter t; None: t is in these field units (a ray of one strand)
    """

    density: Callable
    grid: object
    o: tuple
    d: tuple
    rate: object = None


class Bundle:
    """A ray with its strands through all fields: where densities overlap, they add."""

    def __init__(self, strands, maxt):
        self.strands, self.single = strands, len(strands) == 1
        self.inverse = [safe_inverse(s.d) for s in strands]
        self.intervals = []
        self.active, self.t0, self.t1 = False, dr.inf, -dr.inf
        for s in strands:
            rate = 1 if s.rate is None else s.rate
            hit, t0, t1 = camera_interval(s.o, s.d, maxt * rate)
            t0, t1 = t0 / rate, t1 / rate
            self.intervals.append((t0, t1))
            self.active = hit | self.active
            self.t0 = dr.minimum(self.t0, dr.select(hit, t0, dr.inf))
            self.t1 = dr.maximum(self.t1, dr.select(hit, t1, -dr.inf))
        self.t0, self.t1 = (dr.select(self.active, t, 0) for t in (self.t0, self.t1))

    def cell(self, t, step):
        """Begin and length of the cell at `t`, cut off where the ray begins and ends (a surface may be there)."""
        begin = dr.maximum(t, self.t0)
        return begin, dr.minimum(t + step, self.t1) - begin

    def at(self, t, active):
        """``(skip, sigmas)``: how far the ray is clear of all matter from `t` on, 0 in an occupied cell; each field's
        density there, per unit of t."""
        skips, places = [], []
        for s, inverse, (t0, t1) in zip(self.strands, self.inverse, self.intervals, strict=True):
            along = t if s.rate is None else t * s.rate
            p = tuple(oi + along * di for oi, di in zip(s.o, s.d, strict=True))
            skip = clear_distance(s.grid, p, inverse)
            if not self.single:
                inside, ahead = (t >= t0) & (t < t1), dr.maximum(self.t1 - t, 1e-6)
                skip = dr.select(inside, skip / s.rate, dr.select(t < t0, dr.minimum(t0 - t, ahead), ahead))
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


@dataclass(frozen=True)
class Samples:
    """Shading points of camera rays, in no particular order: `ray` index, distance `t`, the weight in each field
    (`weights`, one array a field, sum w), `view`: transmittance from the camera to the very point, or None;
    `transmittance`, per ray: of the whole ray."""

    ray: object
    t: object
    weights: tuple
    view: object
    transmittance: object


def camera_samples(strands, maxt, step, offset, depth, shade=True, view=False) -> Samples:
    """Shading points of camera rays, compacted.

    strands   of each ray, one for each field
    maxt      where each ray ends (a surface, or infinity)
    step      cell length, in units of t
    offset    per ray, uniform in [0, 1): where its lattice of cells begins
    depth     per ray, uniform in [0, 1): where in its cell a sample lies, as a quantile of the light lost in that cell
    shade     whether there is use for the samples; otherwise only `transmittance` is found
    view      whether `view` is wanted

    Quadrature of method.md, section 1: α_j = 1 − e^(−σ_j Δ), w_j = T_j α_j, σ_j at the middle of cell j, the sum over
    the fields. The sample lies where free flight through the cell's constant σ_j would end, so that quantities that
    vary within a cell, above all the light's own transmittance, are averaged with the right weights: the expectation
    over `depth` is exact for constant σ_j. Up to that point the cell lets 1 − depth·α_j through.

    Samples with w ≤ MIN_WEIGHT_RATE · step are left out.
    """
    # First walk: count. Second: write. Costs little beside shading and needs no guess of the capacity.
    bundle = Bundle(strands, maxt)
    floats, uint = type(bundle.t0), dr.uint32_array_t(type(bundle.t0))
    rays = dr.arange(uint, dr.width(bundle.t0))

    def tally(hit, sample, state):
        return (state[0] + dr.select(hit, uint(1), 0),)

    transmittance, (count,) = _walk(bundle, step, offset, depth, tally, (dr.zeros(uint, dr.width(rays)),))
    total = 0
    if shade:
        start = dr.prefix_sum(count)
        total = int(dr.sum(count)[0])
    out = dr.zeros(uint, total), *(dr.zeros(floats, total) for _ in range(1 + len(strands) + view))
    if total:

        def write(hit, sample, state):
            slot, *targets = state
            for target, value in zip(targets, (rays, *sample[: len(targets) - 1]), strict=True):
                dr.scatter(target, value, slot, hit)
            return slot + dr.select(hit, uint(1), 0), *targets

        _, (_, *out) = _walk(bundle, step, offset, depth, write, (start, *out))
        dr.eval(out, transmittance)
    weights = tuple(out[2 : 2 + len(strands)])
    return Samples(out[0], out[1], weights, out[-1] if view else None, transmittance)


def camera_light(strands, maxt, step, offset, depth, reflect):
    """The light of camera rays whose lights all shine from the camera, in one walk: the view's transmittance is theirs.

    Arguments as :func:`camera_samples`; ``reflect(i, t, view)``: radiance, a 3-tuple, that the point of strand `i` at
    `t`, `view` of whose light gets to the camera, reflects. Returns ``(radiance, transmittance)`` per ray.
    """
    bundle = Bundle(strands, maxt)

    def shade(t, shares, view, *light):
        for i, share in enumerate(shares):
            light = [c + share * v for c, v in zip(light, reflect(i, t, view), strict=True)]
        return tuple(light)

    def add(hit, sample, state):
        t, *shares, view = sample
        # Few cells hold samples that count: the branch skips what the others would cost.
        return dr.if_stmt((t, shares, view, *state), hit, shade, lambda t, shares, view, *light: light, label="shade")

    zero = dr.zeros(type(bundle.t0), dr.width(bundle.t0))
    transmittance, light = _walk(bundle, step, offset, depth, add, (zero, type(zero)(zero), type(zero)(zero)))
    return light, transmittance


def _walk(bundle, step, offset, depth, emit, state):
    """One walk along the camera rays of `bundle`; ``emit(hit, sample, state)`` gives the next state and is called for
    each cell, `hit` where it holds a sample that counts: t, the weight in each field, and the view's transmittance.
    Returns ``(transmittance, state)``."""
    t0, t1 = bundle.t0 - offset * step, bundle.t1
    floats, uint = type(t0), dr.uint32_array_t(type(t0))

    def body(k, transmittance, state, active):
        begin, length = bundle.cell(t0 + floats(k) * step, step)
        skip, sigmas = bundle.at(begin + 0.5 * length, active)
        empty = skip > 0
        sigma = sum(sigmas[1:], sigmas[0])
        alpha = 1 - dr.exp(-sigma * length)
        w = transmittance * alpha
        lost = depth * alpha
        rate = dr.rcp(dr.maximum(sigma, 1e-6))
        shares = (w,) if bundle.single else tuple(w * s * rate for s in sigmas)
        sample = begin - dr.log(1 - lost) * rate, *shares, transmittance * (1 - lost)
        state = emit(active & (w > MIN_WEIGHT_RATE * step), sample, state)
        transmittance = dr.select(active, transmittance - w, transmittance)
        # Not in place: a state variable is the caller's own array, and the next walk starts from it again.
        k = k + dr.select(empty, uint(skip / step) + 1, 1)
        active = active & (t0 + floats(k) * step < t1) & (transmittance > MIN_TRANSMITTANCE)
        return k, transmittance, state, active

    _, transmittance, state, _ = dr.while_loop(
        state=(dr.zeros(uint, dr.width(t0)), dr.ones(floats, dr.width(t0)), state, bundle.active),
        cond=lambda k, transmittance, state, active: active,
        body=body,
        label="camera march",
    )
    return dr.select(transmittance > MIN_TRANSMITTANCE, transmittance, 0), state


def free_flight(strands, maxt, step, offset, depth, which):
    """Where rays end in the fields if they pass the optical depth `depth` (for free flight −ln(1 − u)).

    Arguments as :func:`camera_samples`; `which`, uniform in [0, 1), says whose matter it is where several overlap.
    Returns ``(hit, t, index)``: whether a ray ends before `maxt`, where, and the strand's index. Linear depth within
    cells.
    """
    bundle = Bundle(strands, maxt)
    t0, t1 = bundle.t0 - offset * step, bundle.t1
    floats, uint = type(t0), dr.uint32_array_t(type(t0))

    def body(k, passed, t, index, active):
        begin, length = bundle.cell(t0 + floats(k) * step, step)
        skip, sigmas = bundle.at(begin + 0.5 * length, active)
        sigma = sum(sigmas[1:], sigmas[0])
        after = passed + sigma * length
        hit = active & (after >= depth) & (sigma > 0)
        t = dr.select(hit, begin + (depth - passed) / dr.maximum(sigma, 1e-6), t)
        rest = which * sigma
        for sigma_i in sigmas[:-1]:
            rest = rest - sigma_i
            index = dr.select(hit & (rest >= 0), index + 1, index)
        k = k + dr.select(skip > 0, uint(skip / step) + 1, 1)
        active = active & ~hit & (t0 + floats(k) * step < t1)
        return k, after, t, index, active

    n = dr.width(t0)
    state = (dr.zeros(uint, n), dr.zeros(floats, n), dr.full(floats, dr.inf, n), dr.zeros(uint, n), bundle.active)
    _, _, t, index, _ = dr.while_loop(
        state=state, cond=lambda k, passed, t, index, active: active, body=body, label="free flight"
    )
    return dr.isfinite(t), t, index
