"""Marches through the fields along camera rays: the points that they shade, and free flight."""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from .bundle import Bundle, Cell, onward
from .samples import Samples

SHARE = 1 / 8
"""Of its ray that a sample stands for: six or seven of a ray that ends in an opaque skin. To equal noise pictures of
`statue`, `knot` and `skull` take 0.7 to 0.9 of the time that cells take of which one is drawn in each 0.04. Under many
lights that are summed, shares of 1/6 would take 0.75 of that; with lights drawn at each point they gain nothing."""
SMOKE_SHARE = 1 / 64
"""The same in a field without opaque skins, whose rays are long to march and meet many a normal: to equal noise
pictures of `cloud` take 0.4 to 0.7 of the time of shares of 1/16 (a point light, 8 drawn lights, 128 summed ones);
1/128 gains nothing more but with a single drawn light."""
GOLDEN = 0.618034
"""Its multiples fill [0, 1) most evenly."""
MIN_SHARE = 1e-4
"""Rays that lose less light have no sample, nor have ends of rays that do."""
MIN_TRANSMITTANCE = 1e-3
"""Camera rays end here; what lies behind could add 0.1 %."""


def share(opaque: bool) -> float:
    """Return the fraction of a ray's light that one sample stands for; `opaque`: the field has opaque skins."""
    return SHARE if opaque else SMOKE_SHARE


def camera_samples(strands, maxt, offset, depth, shade=True, view=False, shares=()) -> Samples:
    """Shading points of camera rays, compacted.

    strands   of each ray, one for each field
    maxt      where each ray ends (a surface, or infinity)
    offset    per ray, uniform in [0, 1): where its lattice of cells begins
    depth     per ray, uniform in [0, 1): where in its shares of the light a sample lies
    shade     whether there is use for the samples; otherwise only `transmittance` is found
    view      whether `view` is wanted
    shares    of its ray that a sample stands for, the least of the strands that it meets: one each; (): SHARE

    Quadrature of method.md, section 1: α_j = 1 − e^(−σ_j Δ), w_j = T_j α_j, σ_j the mean density of cell j, the sum
    over the fields, asked at the ends of its pieces. A sample stands for a share of the light that the ray loses, the
    last one for what remains, and lies where the ray has lost so much: by `depth` in each share, so that quantities
    that vary along the ray, above all the light's own transmittance, are averaged with the right weights. In its cell
    it lies where free flight through the pieces would end: the expectation over `depth` is right for densities
    exponential across each piece. Of the shares that end in one cell one sample stands for all that have none yet. It
    follows the march continuously: rounding moves a sample by as little as the light before it, and does not choose
    among cells, but in the last, unfinished share.
    """
    bundle = Bundle(strands, maxt, offset)
    uint = dr.uint32_array_t(type(bundle.base))
    n, channels = dr.width(bundle.base), 1 + len(strands) + view
    shares = shares or (SHARE,) * len(strands)
    most = math.ceil(1 / min(shares))
    transmittance, count, found = _gather(bundle, depth, channels if shade else 0, _sizes(bundle, shares), most)
    dr.eval(transmittance, count, found)  # together, or each would walk by itself
    total, start = 0, dr.zeros(uint, n)
    if shade:
        start = dr.prefix_sum(count)
        total = int(dr.sum(count)[0])
    ray, values = _compact(count, start, total, found if total else [dr.zeros(type(bundle.base))] * channels)
    dr.eval(ray, values, start)
    weights = tuple(values[1 : 1 + len(strands)])
    return Samples(bundle, ray, values[0], weights, values[-1] if view else None, transmittance, start, count)


def _sizes(bundle, shares):
    """Return the fraction of a ray's light that one of its samples stands for, per ray."""
    size = 1
    for share, (begin, _) in zip(shares, bundle.intervals, strict=True):
        size = dr.minimum(size, dr.select(dr.isfinite(begin), dr.opaque(type(bundle.base), share), 1))
    return size


def _gather(bundle, depth, channels: int, size, most: int):
    """Walks along all rays: their transmittance, how many samples each has, `most` at most, one for each `size` of the
    light, and `channels` arrays of what they are, the first samples of all rays before the second ones, and so on."""
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))
    n = dr.width(bundle.base)
    per_light = dr.rcp(size)
    found = [dr.empty(floats, most * n) for _ in range(channels)]
    ray, rays = dr.arange(uint, n), dr.opaque(uint, n)

    def put(count, ray, sample, weight):
        room = count < most
        for target, value in zip(found, _weighted(sample, weight), strict=False):  # the view only where wanted
            dr.scatter(target, value, count * rays + ray, room)
        return count + dr.select(room, uint(1), 0)

    def put_here(count, ray, here, light, weight):
        return put(count, ray, here.sample(here.quantile(light)), weight)

    def none(count, *rest):
        return count

    def look(count, ray, depth, here, last, *kept):
        # In shares: the light that is lost before the cell and after it.
        begin, end = ((1 - left) * per_light for left in (here.transmittance, here.transmittance - here.weight))
        now = dr.floor(end)
        early, others, place = _closing(depth, begin, now)
        count = dr.if_stmt((count, ray, kept, dr.select(early, size, 0)), early, put, none, label="earlier sample")
        count = dr.if_stmt((count, ray, here, place * size, others * size), others > 0, put_here, none, label="sample")
        # The share that is still open: until its own place is reached, one is chosen by weight.
        aim, rest, low = now + _place(depth, now), end - now, dr.maximum(now, begin)
        reached, chance = aim < end, _uniform(depth, here.number) * rest
        take = dr.select(reached, aim >= begin, chance < end - low)
        at = here.sample(here.quantile(dr.select(reached, aim, low + chance) * size))
        kept = tuple(dr.select(take, a, b) for a, b in zip(at, kept, strict=True))
        weight, ends = rest * size, last & (rest * size > MIN_SHARE)
        return dr.if_stmt((count, ray, kept, weight), ends, put, none, label="last sample"), *kept

    def gather(active, last, here, state):
        wanted = active & ((here.weight > 0) | last)
        return dr.if_stmt((state[0], ray, depth, here, last, *state[1:]), wanted, look,
                          lambda count, ray, depth, here, last, *kept: (count, *kept), label="samples")

    zero = dr.zeros(floats, n)
    state = dr.zeros(uint, n), *(type(zero)(zero) for _ in range(len(bundle.strands) + 2))
    transmittance, (count, *_) = _walk(bundle, gather, state)
    return transmittance, count, found


def _closing(depth, begin, now):
    """Return ``(early, others, place)`` of the shares that end in a cell.

    The cell begins after `begin` shares and ends in share `now`. `early`: one of these shares has its sample in an
    earlier cell. `others`: number of the others. `place`: where the light of the one sample ends that stands for them,
    in shares. It is uniform, spread over the samples of a pixel as evenly as `depth`, and lies at the cell's beginning
    where `early` turns on the last bit.
    """
    first = dr.floor(begin)
    place, passed = _place(depth, first), begin - first
    early = (now > first) & (place < passed)
    others = now - first - dr.select(early, 1, 0)
    # As it is known whether `place` is less than `passed`, it is uniform on one side.
    away = dr.abs(place - passed) * dr.rcp(dr.maximum(dr.select(early, passed, 1 - passed), 1e-6))
    return early, others, begin + dr.minimum(away, 1) * (now - begin)


def _place(depth, number):
    """Return the place of a ray's sample within its share `number`, in [0, 1).

    Places are spread evenly over the shares of a ray, and over rays as `depth` is.
    """
    place = depth + number * GOLDEN
    return place - dr.floor(place)


def _weighted(sample, weight) -> tuple:
    """``(t, *weights, view)`` of a :meth:`_Here.sample` that stands for `weight`: in each field by its share."""
    t, *shares, view = sample
    scale = weight * dr.rcp(dr.maximum(sum(shares[1:], shares[0]), 1e-30)) if len(shares) > 1 else None
    return t, *((weight,) if scale is None else (share * scale for share in shares)), view


def _uniform(depth, number):
    """A number in [0, 1) of a ray's `depth` and the `number` of a cell."""
    uint = dr.uint32_array_t(type(depth))
    bits = (uint(depth * 2**24) * 0x9E3779B1) ^ (number * 0x85EBCA77)
    for factor in (0x2C1B3C6D, 0x297A2D39):
        bits = (bits ^ (bits >> 15)) * factor
    return type(depth)((bits ^ (bits >> 15)) >> 8) * 2**-24


def _compact(count, start, total: int, found: list):
    """``(ray, values)`` of `total` samples, those of one ray side by side: those that :func:`_gather` `found`."""
    uint, n = type(count), dr.width(count)
    ray, values = dr.zeros(uint, total), [dr.zeros(type(v), total) for v in found]
    mine, rays = dr.arange(uint, n), dr.opaque(uint, n)

    def body(k):
        dr.scatter(ray, mine, start + k)
        for target, source in zip(values, found, strict=True):
            dr.scatter(target, dr.gather(type(source), source, k * rays + mine), start + k)
        return (k + 1,)

    if not total:
        return ray, values
    dr.eval(start)
    dr.while_loop(state=(dr.zeros(uint, n),), cond=lambda k: k < count, body=body, label="side by side")
    return ray, values


@dataclass
class _Here:
    """A cell on a walk: its lattice's `t`, and how many of its length it is from the beginning (`number`), the view's
    `transmittance` to it, the share `alpha` of it that the cell takes, its `weight`, and that of each field
    (`shares`)."""

    t: Any
    number: Any
    transmittance: Any
    alpha: Any
    weight: Any
    shares: tuple
    cell: Cell

    def quantile(self, light):
        """The share of what the cell takes where the ray has lost so much `light`, in [0, 1]."""
        return dr.clip((light - (1 - self.transmittance)) * dr.rcp(dr.maximum(self.weight, 1e-30)), 0, 1)

    def sample(self, u) -> tuple:
        """``(t, *shares, view)`` at the quantile `u` of what the cell takes."""
        lost = u * self.alpha
        return self.cell.place(-dr.log(1 - lost)), *self.shares, self.transmittance * (1 - lost)


def _walk(bundle, emit, state):
    """Walk along the camera rays of `bundle`; return ``(transmittance, state)``.

    ``emit(active, last, here, state)`` is called for each cell, a :class:`_Here`, and returns the next state; `last`:
    the cell is the ray's last one.
    """
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))

    def body(t, transmittance, before, state, active):
        step = bundle.step(t)
        cell = bundle.cell(t, step, active, before)
        alpha = _absorbed(cell.depth)
        w = transmittance * alpha
        shares = (w,) if bundle.single else tuple(transmittance * share for share in cell.shares())
        number = uint((t - bundle.begin) * dr.rcp(step) + 0.5)
        here = _Here(t, number, transmittance, alpha, w, shares, cell)
        transmittance = dr.select(active, transmittance - w, transmittance)
        t = t + onward(cell.skip, step, 0)
        onwards = active & (t < bundle.end) & (transmittance > MIN_TRANSMITTANCE)
        return t, transmittance, cell.after, emit(active, active & ~onwards, here, state), onwards

    _, transmittance, _, state, _ = dr.while_loop(
        state=(floats(bundle.begin), dr.ones(floats, dr.width(bundle.base)), bundle.first(), state, bundle.active),
        cond=lambda t, transmittance, before, state, active: active,
        body=body,
        label="camera march",
    )
    return dr.select(transmittance > MIN_TRANSMITTANCE, transmittance, 0), state


def _absorbed(depth):
    """1 − e^−depth, with all its digits where depth is small: choices among faint cells would turn on rounding."""
    return dr.select(depth < 0.02, depth * (1 - depth * (0.5 - depth * (1 / 6))), 1 - dr.exp(-depth))


def free_flight(strands, maxt, offset, depths):
    """Return ``(hit, t, index)`` of the first field that stops each ray.

    Each field stops a ray at an optical depth of its own (`depths`, one array a strand; for free flight −ln(1 − u) with
    an own u). The first of these ends is distributed as in the sum of all densities. Other arguments: as in
    :func:`camera_samples`. `hit`: the ray ends before `maxt`; `t`: distance from its origin (`maxt` if it does not);
    `index`: the strand. Densities are exponential across the pieces of cells.
    """
    end, hit, index = maxt, False, 0
    for i, (strand, depth) in enumerate(zip(strands, depths, strict=True)):
        bundle = Bundle([strand], end, offset)
        t = bundle.base + _flight(bundle, depth)
        stopped = dr.isfinite(t)
        end, hit, index = dr.select(stopped, t, end), stopped | hit, dr.select(stopped, i, index)
    return hit, end, dr.uint32_array_t(type(end))(index)


def _flight(bundle, depth):
    """t where the rays of one strand end; infinity where they do not."""
    floats = type(bundle.base)

    def body(t, passed, end, before, active):
        step = bundle.step(t)
        cell = bundle.cell(t, step, active, before)
        after = passed + cell.depth
        hit = active & (after >= depth) & (after > passed)
        end = dr.select(hit, cell.place(depth - passed), end)
        t = t + onward(cell.skip, step, 0)
        return t, after, end, cell.after, active & ~hit & (t < bundle.end)

    n = dr.width(bundle.base)
    state = (floats(bundle.begin), dr.zeros(floats, n), dr.full(floats, dr.inf, n), bundle.first(), bundle.active)
    return dr.while_loop(
        state=state, cond=lambda t, passed, end, before, active: active, body=body, label="free flight")[2]
