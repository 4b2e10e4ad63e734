"""The shading points that a march finds along camera rays (:mod:`mi_ntf.infer.march`)."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from .bundle import Bundle


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

    def draw(self, u) -> tuple:
        """``(t, strand, weight)``, per ray: of one of its samples, drawn by `u`, uniform in [0, 1), and their weights;
        and the weight of all, 0 where there is none."""
        uint, count, n = type(self.count), self.count, dr.width(self.count)
        t, strand = dr.zeros(type(self.t), n), dr.zeros(uint, n)
        if not dr.width(self.t):
            return t, strand, dr.zeros(type(self.t), n)
        weight: Any = sum(self.totals(list(self.weights)))

        def more(k, rest, t, strand):
            return (k < count) & (rest >= 0)

        def body(k, rest, t, strand):
            for i, share in enumerate(self.weights):
                w = dr.gather(type(share), share, self.first + k, k < count)
                here = (rest >= 0) & (w > 0)
                t = dr.select(here, dr.gather(type(self.t), self.t, self.first + k, k < count), t)
                strand = dr.select(here, i, strand)
                rest = rest - w
            return k + 1, rest, t, strand

        state: Any = (dr.zeros(uint, n), u * weight, t, strand)
        _, _, t, strand = dr.while_loop(state=state, cond=more, body=body, label="one sample of a ray")
        return t, strand, weight
