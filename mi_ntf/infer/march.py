"""Marches through the fields along camera rays: their shading points, and free flight."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr

from . import ops, tuning
from .bundle import Bundle, Cell, Strand, onward
from .samples import Samples
from .skin import Smoke, Softness
from .types import Array, Float, Mask, UInt32

GOLDEN = 0.618034
"""Inverse golden ratio, whose multiples fill [0, 1) most evenly."""
MIN_LOSS = 1e-4
"""Loss of light, fraction of the ray's, below which a ray or its end has no sample."""
MIN_TRANSMITTANCE = 1e-3
"""Transmittance at which camera rays end; matter behind could add 0.1 %."""
State: TypeAlias = tuple[Array, ...]


def sample_fraction(softness: Softness | Smoke) -> float:
    """Return the fraction of a ray's light that one sample stands for.

    It is small only where rays meet many normals. A phase function varies as little along a ray as an opaque skin.
    """
    many_normals = not softness.opaque and not isinstance(softness, Smoke)
    return tuning.SMOKE_SAMPLE_FRACTION if many_normals else tuning.SAMPLE_FRACTION


def camera_samples(strands: Sequence[Strand], maxt: Float, offset: Float, depth: Float, shade: bool = True,
                   view: bool = False, fractions: Sequence[float] = ()) -> Samples:
    """Return shading points of camera rays, compacted.

    Parameters
    ----------
    strands
        Strands of each ray, one for each field.
    maxt
        End of each ray (a surface, or infinity).
    offset
        Begin of each ray's lattice of cells, uniform in [0, 1).
    depth
        Place of a ray's samples within their portions of the light, uniform in [0, 1).
    shade
        Return samples; otherwise only their `transmittance`.
    view
        Return the `view` transmittance.
    fractions
        For each strand the fraction of the light that a sample stands for; a ray takes the least one of the strands
        that it meets. (): SAMPLE_FRACTION.

    Notes
    -----
    Quadrature of emission and absorption (Max 1995): α_j = 1 − e^(−σ_j Δ), w_j = T_j α_j, σ_j the mean density of
    cell j, the sum over the fields, evaluated at the ends of its pieces. The light that a ray loses is divided into
    portions of equal size, the last one smaller. A sample stands for a portion and lies where the ray has lost a
    `depth` of it. So quantities that vary along the ray, above all the light's own transmittance, are averaged with
    the right weights. In its cell a sample lies where free flight through the pieces would end: the expectation
    over `depth` is right for densities exponential across each piece. Samples follow the march continuously:
    rounding moves a sample slightly but does not choose among cells, except in the last portion. So their places
    depend on the light alone, not on how cells lie, and `depth` stratifies them over the samples of a pixel.
    """
    bundle = Bundle(strands, maxt, offset)
    uint = dr.uint32_array_t(type(bundle.base))
    n, channels = dr.width(bundle.base), 1 + len(strands) + view
    fractions = fractions or (tuning.SAMPLE_FRACTION,) * len(strands)
    most = math.ceil(1 / min(fractions))
    transmittance, count, samples = _gather(bundle, depth, channels if shade else 0, _sizes(bundle, fractions), most)
    dr.eval(transmittance, count, samples)  # together, or each would march by itself
    total, start = 0, dr.zeros(uint, n)
    if shade:
        start = dr.prefix_sum(count)
        total = int(dr.sum(count)[0])
    ray, values = _compact(count, start, total, samples if total else [dr.zeros(type(bundle.base))] * channels)
    dr.eval(ray, values, start)
    weights = tuple(values[1 : 1 + len(strands)])
    return Samples(bundle, ray, values[0], weights, values[-1] if view else None, transmittance, start, count)


def _sizes(bundle: Bundle, fractions: Sequence[float]) -> Float:
    """Return the size of each ray's portions, as a fraction of its light."""
    size: Float = 1
    for fraction, (begin, _) in zip(fractions, bundle.intervals, strict=True):
        size = dr.minimum(size, dr.select(dr.isfinite(begin), dr.opaque(type(bundle.base), fraction), 1))
    return size


def _gather(bundle: Bundle, depth: Float, channels: int, size: Float,
            most: int) -> tuple[Float, UInt32, list[Float]]:
    """March along all rays and return their transmittance, number of samples and samples.

    `size`: of a ray's portions of light; `most`: largest number of samples of a ray. The samples are `channels` arrays:
    the first samples of all rays before the second ones, and so on.
    """
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))
    n = dr.width(bundle.base)
    per_light = dr.rcp(size)
    samples = [dr.empty(floats, most * n) for _ in range(channels)]
    ray, rays = dr.arange(uint, n), dr.opaque(uint, n)

    def put(count: UInt32, ray: UInt32, sample: State, weight: Float) -> UInt32:
        room = count < most
        for target, value in zip(samples, _weighted(sample, weight), strict=False):  # without `view`, one less
            dr.scatter(target, value, count * rays + ray, room)
        return count + dr.select(room, uint(1), 0)

    def put_portions(count: UInt32, ray: UInt32, depth: Float, here: "_Here", number: Float, end: Float) -> UInt32:
        # One sample for each of the portions from `number` to `end`.
        def body(count: UInt32, number: Float) -> tuple[UInt32, Float]:
            light = (number + _place(depth, number)) * size
            return put(count, ray, here.sample(here.quantile(light)), size), number + 1

        after: UInt32 = ops.while_loop(state=(count, number), cond=lambda count, number: number < end, body=body,
                                       label="samples of a cell")[0]
        return after

    def none(count: UInt32, *rest: Array) -> UInt32:
        return count

    def look(count: UInt32, ray: UInt32, depth: Float, here: "_Here", last: Mask, *open_sample: Float) -> State:
        # The light that is lost before the cell and after it, in portions.
        begin, end = ((1 - light) * per_light for light in (here.transmittance, here.transmittance - here.weight))
        first, now = dr.floor(begin), dr.floor(end)
        # Of the portions that end in this cell, the first may have its sample in an earlier one.
        early = (now > first) & (_place(depth, first) < begin - first)
        count = ops.if_stmt((count, ray, open_sample, size), early, put, none, label="earlier sample")
        first = first + dr.select(early, 1, 0)
        count = ops.if_stmt((count, ray, depth, here, first, now), first < now, put_portions, none, label="sample")
        # The portion that is still open: until its own place is reached, a sample is chosen by weight.
        aim, rest, low = now + _place(depth, now), end - now, dr.maximum(now, begin)
        reached, chance = aim < end, _uniform(depth, here.number) * rest
        take = dr.select(reached, aim >= begin, chance < end - low)
        at = here.sample(here.quantile(dr.select(reached, aim, low + chance) * size))
        open_sample = tuple(dr.select(take, a, b) for a, b in zip(at, open_sample, strict=True))
        weight, ends = rest * size, last & (rest * size > MIN_LOSS)
        return ops.if_stmt((count, ray, open_sample, weight), ends, put, none, label="last sample"), *open_sample

    def skip(count: UInt32, ray: UInt32, depth: Float, here: "_Here", last: Mask, *open_sample: Float) -> State:
        return count, *open_sample

    def gather(active: Mask, last: Mask, here: "_Here", state: State) -> State:
        matter = active & ((here.weight > 0) | last)
        result: State = ops.if_stmt((state[0], ray, depth, here, last, *state[1:]), matter, look, skip, label="samples")
        return result

    zero = dr.zeros(floats, n)
    state: State = dr.zeros(uint, n), *(type(zero)(zero) for _ in range(len(bundle.strands) + 2))
    transmittance, (count, *_) = _walk(bundle, gather, state)
    return transmittance, count, samples


def _place(depth: Float, number: Float) -> Float:
    """Return the place of a ray's sample within its portion `number`, in [0, 1).

    Places are spread evenly over the portions of a ray, and over rays as `depth` is.
    """
    place = depth + number * GOLDEN
    return place - dr.floor(place)


def _weighted(sample: State, weight: Float) -> State:
    """Return ``(t, *weights, view)`` of a :meth:`_Here.sample` that stands for `weight`, divided among the fields."""
    t, *parts, view = sample
    total: Float = sum(parts[1:], parts[0])
    scale = weight * dr.rcp(dr.maximum(total, 1e-30)) if len(parts) > 1 else None
    return t, *((weight,) if scale is None else (part * scale for part in parts)), view


def _uniform(depth: Float, number: UInt32) -> Float:
    """Return a number in [0, 1), a function of a ray's `depth` and the `number` of a cell."""
    uint: Array = dr.uint32_array_t(type(depth))
    bits = (uint(depth * 2**24) * 0x9E3779B1) ^ (number * 0x85EBCA77)
    for factor in (0x2C1B3C6D, 0x297A2D39):
        bits = (bits ^ (bits >> 15)) * factor
    return type(depth)((bits ^ (bits >> 15)) >> 8) * 2**-24


def _compact(count: UInt32, start: UInt32, total: int, samples: list[Float]) -> tuple[UInt32, list[Float]]:
    """Return ``(ray, values)`` of the `total` samples of :func:`_gather`, those of one ray side by side."""
    uint, n = type(count), dr.width(count)
    ray, values = dr.zeros(uint, total), [dr.zeros(type(v), total) for v in samples]
    mine, rays = dr.arange(uint, n), dr.opaque(uint, n)

    def body(k: UInt32) -> tuple[UInt32]:
        dr.scatter(ray, mine, start + k)
        for target, source in zip(values, samples, strict=True):
            dr.scatter(target, dr.gather(type(source), source, k * rays + mine), start + k)
        return (k + 1,)

    if not total:
        return ray, values
    dr.eval(start)
    ops.while_loop(state=(dr.zeros(uint, n),), cond=lambda k: k < count, body=body, label="side by side")
    return ray, values


@dataclass
class _Here:
    """A cell on a march."""

    number: UInt32
    """Number of the cell, counted from the begin of the lattice in cells of this length."""
    transmittance: Float
    """Transmittance of the view up to the cell."""
    alpha: Float
    """Fraction of it that the cell absorbs."""
    weight: Float
    """Light that the cell absorbs."""
    parts: tuple[Float, ...]
    """The same for each field."""
    cell: Cell

    def quantile(self, light: Float) -> Float:
        """Return the fraction of the cell's absorption where the ray has lost so much `light`, in [0, 1]."""
        return dr.clip((light - (1 - self.transmittance)) * dr.rcp(dr.maximum(self.weight, 1e-30)), 0, 1)

    def sample(self, u: Float) -> State:
        """Return ``(t, *parts, view)`` at the quantile `u` of the cell's absorption."""
        lost = u * self.alpha
        return self.cell.place(-dr.log(1 - lost)), *self.parts, self.transmittance * (1 - lost)


def _walk(bundle: Bundle, emit: Callable[[Mask, Mask, _Here, State], State], state: State) -> tuple[Float, State]:
    """March along the camera rays of `bundle`; return ``(transmittance, state)``.

    ``emit(active, last, here, state)`` is called for each cell and returns the next state; `last`: the cell is the
    ray's last one.
    """
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))

    def body(t: Float, transmittance: Float, before: State, state: State, active: Mask) -> State:
        step = bundle.step(t)
        cell = bundle.cell(t, step, active, before)
        alpha = _absorbed(cell.depth)
        w = transmittance * alpha
        parts = (w,) if bundle.single else tuple(transmittance * fraction for fraction in cell.absorbed())
        number = uint((t - bundle.begin) * dr.rcp(step) + 0.5)
        here = _Here(number, transmittance, alpha, w, parts, cell)
        transmittance = dr.select(active, transmittance - w, transmittance)
        t = t + onward(cell.skip, step, 0)
        onwards = active & (t < bundle.end) & (transmittance > MIN_TRANSMITTANCE)
        return t, transmittance, cell.after, emit(active, active & ~onwards, here, state), onwards

    start = (floats(bundle.begin), dr.ones(floats, dr.width(bundle.base)), bundle.first(), state, bundle.active)
    _, transmittance, _, state, _ = ops.while_loop(
        state=start,
        cond=lambda t, transmittance, before, state, active: active,
        body=body,
        label="camera march",
    )
    return dr.select(transmittance > MIN_TRANSMITTANCE, transmittance, 0), state


def _absorbed(depth: Float) -> Float:
    """Return 1 − e^−depth, with all digits where depth is small: rounding must not choose among faint cells."""
    return dr.select(depth < 0.02, depth * (1 - depth * (0.5 - depth * (1 / 6))), 1 - dr.exp(-depth))


def free_flight(strands: Sequence[Strand], maxt: Float, offset: Float,
                depths: Sequence[Float]) -> tuple[Mask, Float, UInt32]:
    """Return ``(hit, t, index)`` of the strand that stops each ray first.

    `depths`: optical depth at which each field stops a ray, one array a strand; for free flight −ln(1 − u) with an
    independent u. The first of these ends is distributed as in the sum of all densities. `hit`: the ray ends before
    `maxt`; `t`: distance from its origin, `maxt` if it does not end. Other arguments as in :func:`camera_samples`.
    """
    end: Float = maxt
    hit: Mask = False
    index: Array = 0
    for i, (strand, depth) in enumerate(zip(strands, depths, strict=True)):
        bundle = Bundle([strand], end, offset)
        t = bundle.base + _flight(bundle, depth)
        stopped = dr.isfinite(t)
        end, hit, index = dr.select(stopped, t, end), stopped | hit, dr.select(stopped, i, index)
    uint: Array = dr.uint32_array_t(type(end))
    return hit, end, uint(index)


def _flight(bundle: Bundle, depth: Float) -> Float:
    """Return t where the rays of one strand end; infinity where they do not."""
    floats = type(bundle.base)

    def body(t: Float, passed: Float, end: Float, before: State, active: Mask) -> State:
        step = bundle.step(t)
        cell = bundle.cell(t, step, active, before)
        after = passed + cell.depth
        hit = active & (after >= depth) & (after > passed)
        end = dr.select(hit, cell.place(depth - passed), end)
        t = t + onward(cell.skip, step, 0)
        return t, after, end, cell.after, active & ~hit & (t < bundle.end)

    n = dr.width(bundle.base)
    state = (floats(bundle.begin), dr.zeros(floats, n), dr.full(floats, dr.inf, n), bundle.first(),
                    bundle.active)
    return ops.while_loop(
        state=state, cond=lambda t, passed, end, before, active: active, body=body, label="free flight")[2]
