"""Shading points along camera rays (:mod:`mi_ntf.infer.march`)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr

from . import ops
from .bundle import Bundle
from .types import Array, Float, Mask, UInt32, Vector
from .visibility.attached_shadow import AttachedDepth


@dataclass(frozen=True)
class Samples:
    """Shading points of camera rays, those of one ray side by side, from the camera on."""

    bundle: Bundle
    ray: UInt32
    """Index of each point's ray."""
    t: Float
    """Place of each point, from the begin of its `bundle`."""
    weights: tuple[Float, ...]
    """Weight of each point in each field, one array a field; their sum is w."""
    view: Float | None
    """Transmittance from the camera to each point, or None."""
    transmittance: Float
    """Transmittance of each whole ray."""
    first: UInt32
    """Index of the first point of each ray."""
    count: UInt32
    """Number of points of each ray."""

    def line(self, i: int, ray: UInt32) -> tuple[Vector, Vector]:
        """Return origins and directions of the rays `ray` in the coordinates of field `i`."""
        s = self.bundle.strands[i]
        o, d = (tuple(dr.gather(type(c), c, ray) for c in v) for v in (s.o, s.d))
        return o, d

    def along(self, i: int, line: tuple[Vector, Vector], t: Float) -> tuple[Float, ...]:
        """Return the points at `t` of a :meth:`line`."""
        rate = self.bundle.strands[i].rate
        t = t if rate is None else t * rate
        return tuple(a + t * b for a, b in zip(*line, strict=True))

    def place(self, i: int, ray: UInt32, t: Float) -> tuple[tuple[Float, ...], Vector]:
        """Return the points at `t` of the rays `ray`, and the rays' directions, in the coordinates of field `i`."""
        line = self.line(i, ray)
        return self.along(i, line, t), line[1]

    def attached(self, depths: Sequence[AttachedDepth | None]) -> "Samples":
        """Return the samples with weights and transmittances that carry the gradients of densities.

        Parameters
        ----------
        depths
            For each field its optical depths, attached; None for fields without gradients.

        Notes
        -----
        The light L = ∫ T σ h dt of a ray, where h is the radiance at t, changes by ∫ T σ h (d(ln σ) − dD) dt, where D
        is the optical depth from the camera to t. Places and radiance of the samples are fixed.
        """
        change = dr.zeros(type(self.t), dr.width(self.t))
        whole = dr.zeros(type(self.t), dr.width(self.transmittance))
        weights = []
        for i, (depth, strand, weight) in enumerate(zip(depths, self.bundle.strands, self.weights, strict=True)):
            if depth is None:
                weights.append(weight)
                continue
            rate = 1 if strand.rate is None else strand.rate
            x, d = self.place(i, self.ray, self.t)
            change += depth.along(x, tuple(-c for c in d), self.t * rate, True)[1]
            whole += depth.along(strand.o, strand.d, self.bundle.end * rate, self.bundle.active)[1]
            weights.append(weight * (1 + depth.relative_change(x)))
        weights = [weight * (1 - change) for weight in weights]
        return replace(self, weights=tuple(weights), transmittance=self.transmittance * (1 - whole))

    def totals(self, values: list[Float], gradients: bool = False) -> list[Float]:
        """Return the sum of each of `values` over each ray's points, always in the same order, unlike atomic sums.

        `gradients`: the values are attached.
        """
        count = self.count

        def more(k: UInt32, sums: list[Float]) -> Mask:
            return k < count

        def body(k: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
            return k + 1, [s + dr.gather(type(s), v, self.first + k, k < count)
                           for s, v in zip(sums, values, strict=True)]  # fmt: skip

        n = dr.width(count)
        state = (dr.zeros(type(count), n), [dr.zeros(type(self.t), n) for _ in values])
        result: list[Float] = ops.while_loop(
            state=state,
            cond=more,
            body=body,
            label="samples of a ray",
            max_iterations=-1 if gradients else None,  # a sum
        )[1]
        return result

    def draw(self, u: Float) -> tuple[Float, UInt32, Float]:
        """Sample one point of each ray by its weight, with `u` uniform in [0, 1): return ``(t, strand, weight)``.

        `weight`: sum of the weights of all points of the ray, 0 where there is none.
        """
        uint, count, n = type(self.count), self.count, dr.width(self.count)
        t, strand = dr.zeros(type(self.t), n), dr.zeros(uint, n)
        if not dr.width(self.t):
            return t, strand, dr.zeros(type(self.t), n)
        weight: Float = sum(self.totals(list(self.weights)))

        def more(k: UInt32, rest: Float, t: Float, strand: UInt32) -> Mask:
            return (k < count) & (rest >= 0)

        def body(k: UInt32, rest: Float, t: Float, strand: UInt32) -> tuple[Array, ...]:
            for i, weights in enumerate(self.weights):
                w = dr.gather(type(weights), weights, self.first + k, k < count)
                here = (rest >= 0) & (w > 0)
                t = dr.select(here, dr.gather(type(self.t), self.t, self.first + k, k < count), t)
                strand = dr.select(here, i, strand)
                rest = rest - w
            return k + 1, rest, t, strand

        state = (dr.zeros(uint, n), u * weight, t, strand)
        _, _, t, strand = ops.while_loop(state=state, cond=more, body=body, label="one sample of a ray")
        return t, strand, weight
