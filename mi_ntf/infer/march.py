"""Marches through the fields along camera rays: the points that they shade, and free flight."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr

from .bundle import PARTS, Bundle, Cell, onward

MIN_TRANSMITTANCE = 1e-3
"""Camera rays end here; what lies behind could add 0.1 %."""


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
    count: Any

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

        def more(k, sums):
            return k < count

        def body(k, sums):
            return k + 1, [s + dr.gather(type(s), v, self.first + k, k < count)
                           for s, v in zip(sums, values, strict=True)]  # fmt: skip

        n = dr.width(count)
        state: Any = (dr.zeros(type(count), n), [dr.zeros(type(self.t), n) for _ in values])
        return dr.while_loop(
            state=state,
            cond=more,
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

    Quadrature of method.md, section 1: α_j = 1 − e^(−σ_j Δ), w_j = T_j α_j, σ_j the mean density of cell j's PARTS,
    each asked in its middle, the sum over the fields. The sample lies where free flight through those parts would end,
    so that quantities that vary within a cell, above all the light's own transmittance, are averaged with the right
    weights: the expectation over `depth` is right for densities linear across each part. Up to that point the cell lets
    1 − depth·α_j through.

    Samples that weigh at most MIN_WEIGHT_RATE times their cell's length in every field are left out.
    """
    # First walk: count. Second: write. Needs no guess of the capacity.
    bundle = Bundle(strands, maxt, offset)
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))
    rays = dr.arange(uint, dr.width(bundle.base))

    def tally(hit, here, state):
        count, t, transmittance = state
        first = hit & (count == 0)
        return (count + dr.select(hit, uint(1), 0), dr.select(first, here.t, t),
                dr.select(first, here.transmittance, transmittance))  # fmt: skip

    begin = (dr.zeros(uint, dr.width(rays)), floats(bundle.begin), dr.ones(floats, dr.width(rays)))
    transmittance, (count, *first) = _walk(bundle, tally, begin)
    total, start = 0, dr.zeros(uint, dr.width(rays))
    if shade:
        start = dr.prefix_sum(count)
        total = int(dr.sum(count)[0])
    out = dr.zeros(uint, total), *(dr.zeros(floats, total) for _ in range(1 + len(strands) + view))
    if total:
        out = _write(bundle, depth, (rays, start, start + count), (*first, count > 0), out)
        dr.eval(out, transmittance, start, count)
    weights = tuple(out[2 : 2 + len(strands)])
    return Samples(bundle, out[0], out[1], weights, out[-1] if view else None, transmittance, start, count)


def _write(bundle, depth, rays, begin, out):
    """The second walk, from where `begin` says that a ray's samples begin: fills `out`, the samples' rays, places and
    weights and maybe view, one entry a slot. `rays`: each one's index, its first slot, and the one after its last."""
    ray, first, end = rays

    def put(slot, ray, depth, here, *out):
        for target, value in zip(out, (ray, *here.sample(depth)), strict=False):  # the view only where wanted
            dr.scatter(target, value, slot)
        return slot + 1, *out

    def skip(slot, ray, depth, here, *out):
        return slot, *out

    def write(hit, here, state):
        slot, *out = state
        # The two walks are two kernels, which a compiler may round differently: a sample that only this one finds has
        # no slot.
        return dr.if_stmt((slot, ray, depth, here, *out), hit & (slot < end), put, skip, label="write")

    _, (_, *out) = _walk(bundle, write, (type(first)(first), *out), begin, lambda state: state[0] < end)
    return out


def camera_light(strands, maxt, offset, depth, reflect):
    """The light of camera rays whose lights all shine from the camera, in one walk: the view's transmittance is theirs.

    Arguments as :func:`camera_samples`; ``reflect(i, x, view)``: radiance, a 3-tuple, that the point `x` of strand
    `i`, `view` of whose light gets to the camera, reflects. Returns ``(radiance, transmittance)`` per ray.
    """
    bundle = Bundle(strands, maxt, offset)

    def shade(depth, here, *light):
        t, *shares, view = here.sample(depth)
        for i, share in enumerate(shares):
            light = [c + share * v for c, v in zip(light, reflect(i, bundle.point(i, t), view), strict=True)]
        return tuple(light)

    def add(hit, here, state):
        # Few cells hold samples that count: the branch skips what the others would cost.
        return dr.if_stmt((depth, here, *state), hit, shade, lambda depth, here, *light: light, label="shade")

    zero = dr.zeros(type(bundle.base), dr.width(bundle.base))
    transmittance, light = _walk(bundle, add, (zero, type(zero)(zero), type(zero)(zero)))
    return light, transmittance


class _Here(NamedTuple):
    """A cell on a walk: its lattice's `t`, the view's `transmittance` to it, the share `alpha` of it that the cell
    takes, its weights (`shares`), one a field."""

    t: Any
    transmittance: Any
    alpha: Any
    shares: tuple
    cell: Cell

    def sample(self, depth) -> tuple:
        """``(t, *shares, view)`` of the sample at the quantile `depth` of what the cell takes."""
        lost = depth * self.alpha
        return self.cell.place(-dr.log(1 - lost)), *self.shares, self.transmittance * (1 - lost)


def _walk(bundle, emit, state, start=None, wanted=None):
    """One walk along the camera rays of `bundle`; ``emit(hit, here, state)`` gives the next state and is called for
    each cell, a :class:`_Here`, `hit` where it holds a sample that counts. Returns ``(transmittance, state)``.

    start   ``(t, transmittance, active)`` to walk on from; None: the rays' beginnings
    wanted  callable: the state → whether to walk on; None: as long as there is light
    """
    floats = type(bundle.base)

    def body(t, transmittance, state, active):
        step = bundle.step(t)
        cell = bundle.cell(t, step, active)
        alpha = 1 - dr.exp(-cell.depth)
        w = transmittance * alpha
        shares = (w,) if bundle.single else tuple(transmittance * share for share in cell.shares())
        state = emit(active & bundle.counts(shares, step), _Here(t, transmittance, alpha, shares, cell), state)
        transmittance = dr.select(active, transmittance - w, transmittance)
        t = t + onward(cell.skip, step, PARTS)
        active = active & (t < bundle.end) & (transmittance > MIN_TRANSMITTANCE)
        return t, transmittance, state, active & wanted(state) if wanted else active

    start = start or (floats(bundle.begin), dr.ones(floats, dr.width(bundle.base)), bundle.active)
    _, transmittance, state, _ = dr.while_loop(
        state=(*start[:2], state, start[2]),
        cond=lambda t, transmittance, state, active: active,
        body=body,
        label="camera march",
    )
    return dr.select(transmittance > MIN_TRANSMITTANCE, transmittance, 0), state


def free_flight(strands, maxt, offset, depth, which):
    """Where rays end in the fields if they pass the optical depth `depth` (for free flight −ln(1 − u)).

    Arguments as :func:`camera_samples`; `which`, uniform in [0, 1), says whose matter it is where several overlap.
    Returns ``(hit, t, index, bundle)``: whether a ray ends before `maxt`, where (t of `bundle`), and the strand's
    index. Densities linear across the parts of cells.
    """
    bundle = Bundle(strands, maxt, offset)
    floats, uint = type(bundle.base), dr.uint32_array_t(type(bundle.base))

    def body(t, passed, end, index, active):
        step = bundle.step(t)
        cell = bundle.cell(t, step, active)
        after = passed + cell.depth
        hit = active & (after >= depth) & (after > passed)
        end = dr.select(hit, cell.place(depth - passed), end)
        if not bundle.single:
            sigmas = cell.densities(depth - passed)
            rest = which * sum(sigmas[1:], sigmas[0])
            for sigma in sigmas[:-1]:
                rest = rest - sigma
                index = dr.select(hit & (rest >= 0), index + 1, index)
        t = t + onward(cell.skip, step, PARTS)
        active = active & ~hit & (t < bundle.end)
        return t, after, end, index, active

    n = dr.width(bundle.base)
    begin = floats(bundle.begin)
    state = (begin, dr.zeros(floats, n), dr.full(floats, dr.inf, n), dr.zeros(uint, n), bundle.active)
    _, _, t, index, _ = dr.while_loop(
        state=state, cond=lambda t, passed, end, index, active: active, body=body, label="free flight"
    )
    return dr.isfinite(t), t, index, bundle
