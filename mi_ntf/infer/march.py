"""Marches through the field: along camera rays (weights) and towards lights (optical depth).

Both skip empty space by the grid's clearance: inside the empty cube around a cell, no step has density. Positions stay
on one lattice per ray, so that skipping changes no value.
"""

import drjit as dr

from ..core import spheres
from . import ops
from .grid import CELLS

MIN_WEIGHT_RATE = 0.02
"""Samples that weigh less than this times their cell's length are not shaded: matter that would add less than 2 % of a
pixel per unit-sphere radius of depth. It is the tail of nearly spent rays, and the faint rim of a skin."""
MIN_TRANSMITTANCE = 1e-3
"""Camera rays end here; what lies behind could add 0.1 %."""
MAX_OPTICAL_DEPTH = 12.0
"""Light rays end here: τ < 6e-6."""


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


def camera_samples(density, grid, o, d, maxt, step, offset, depth):
    """Shading points of camera rays, compacted.

    density   callable, field density at a point
    o, d      ray origins and unit directions, 3-tuples
    maxt      where each ray ends (a surface, or infinity)
    step      cell length, field units
    offset    per ray, uniform in [0, 1): where its lattice of cells begins
    depth     per ray, uniform in [0, 1): where in its cell a sample lies, as a quantile of the light lost in that cell

    Quadrature of method.md, section 1: α_j = 1 − e^(−σ_j Δ), w_j = T_j α_j, σ_j at the middle of cell j. The sample
    lies where free flight through the cell's constant σ_j would end, so that quantities that vary within a cell, above
    all the light's own transmittance, are averaged with the right weights: the expectation over `depth` is exact for
    constant σ_j.

    Returns ``(ray, t, w, T)``: ray index, distance and weight of every sample with w > MIN_WEIGHT_RATE · step (in no
    particular order); T, per ray, the transmittance of the whole ray.
    """
    active, t0, t1 = camera_interval(o, d, maxt)
    t0 = t0 - offset * step
    inverse = safe_inverse(d)
    floats, uint = type(t0), dr.uint32_array_t(type(t0))
    rays = dr.arange(uint, dr.width(t0))

    def march(emit, state):
        """One walk along the rays; `emit(k, t, w, state)` is called for each sample that counts."""

        def body(k, transmittance, state, active):
            t_cell = t0 + floats(k) * step
            t = t_cell + 0.5 * step
            p = tuple(oi + t * di for oi, di in zip(o, d, strict=True))
            skip = clear_distance(grid, p, inverse)
            empty = skip > 0
            sigma = dr.select(active & ~empty, density(p), 0)
            alpha = 1 - dr.exp(-sigma * step)
            w = transmittance * alpha
            inside = -dr.log(1 - depth * alpha) / dr.maximum(sigma, 1e-6)
            state = emit(active & (w > MIN_WEIGHT_RATE * step), t_cell + inside, w, state)
            transmittance = dr.select(active, transmittance - w, transmittance)
            # Not in place: a state variable is the caller's own array, and the second walk starts from it again.
            k = k + dr.select(empty, uint(skip / step) + 1, 1)
            active = active & (t0 + floats(k) * step < t1) & (transmittance > MIN_TRANSMITTANCE)
            return k, transmittance, state, active

        return dr.while_loop(
            state=(dr.zeros(uint, dr.width(t0)), dr.ones(floats, dr.width(t0)), state, active),
            cond=lambda k, transmittance, state, active: active,
            body=body,
            label="camera march",
        )

    # First walk: count. Second: write. Costs little beside shading and needs no guess of the capacity.
    _, transmittance, (count,), _ = march(
        lambda hit, t, w, n: (n[0] + dr.select(hit, uint(1), 0),), (dr.zeros(uint, dr.width(t0)),)
    )
    transmittance = dr.select(transmittance > MIN_TRANSMITTANCE, transmittance, 0)
    start = dr.prefix_sum(count)
    total = int(dr.sum(count)[0])
    out = dr.zeros(uint, total), dr.zeros(floats, total), dr.zeros(floats, total)
    if total:

        def write(hit, t, w, state):
            slot, *targets = state
            for target, value in zip(targets, (rays, t, w), strict=True):
                dr.scatter(target, value, slot, hit)
            return slot + dr.select(hit, uint(1), 0), *targets

        _, _, (_, *out), _ = march(write, (start, *out))
        dr.eval(out, transmittance)
    return *out, transmittance


def optical_depth(density, grid, x, d, length, steps, active):
    """∫ σ along x + t d for t in [0, length], clipped to the unit sphere; stops at MAX_OPTICAL_DEPTH. `x` may lie
    outside.

    `steps` = (shortest, longest, growth): the step at distance t is growth · t between the two bounds. Shading points
    lie inside the skin, where the depth is made, so steps are fine there and coarse far away. `offset` in [0, 1), per
    ray, places each step's sample.
    """
    hit, _m, h = spheres.chord(ops, x, d)
    here = spheres.coordinate(x, d)
    begin, end = dr.maximum(-h - here, 0), dr.minimum(length, h - here)
    shortest, longest, growth = steps
    inverse = safe_inverse(d)

    def body(t, depth, active):
        step = dr.minimum(dr.clip(growth * t, shortest, longest), end - t)
        p = tuple(xi + t * di for xi, di in zip(x, d, strict=True))
        skip = clear_distance(grid, p, inverse)
        empty = skip > 0
        at = t + 0.5 * step
        q = tuple(xi + at * di for xi, di in zip(x, d, strict=True))
        sigma = density(q)
        depth = dr.select(active & ~empty, depth + sigma * step, depth)
        t = t + dr.select(empty, skip + 1e-4, step)
        return t, depth, active & (t < end - 1e-5) & (depth < MAX_OPTICAL_DEPTH)

    zero = dr.zeros(type(x[0]), dr.width(x[0]))
    state = (begin, zero, active & hit & (end > begin))
    return dr.while_loop(state=state, cond=lambda t, depth, active: active, body=body, label="light march")[1]
