"""Loops over points and lights, and the clock that compares them."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.infer import march, shade
from mi_ntf.infer.bundle import Strand
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.samples import Samples

SAMPLES = 384
"""Steps across the unit sphere's diameter, as integrators have by default."""
POINTS = 1 << 15
"""Points that lights are looked up at."""


def table_of(where: np.ndarray, is_point: bool = False) -> LightTable:
    """Lights of power 1 at, or towards, `where` (n, 3), field coordinates."""
    return LightTable(where, np.ones((len(where), 3)), np.full(len(where), is_point), 1.0, mi)


def seconds(work: dict[str, Callable[[], Any]], repeats: int, pick=statistics.median) -> dict[str, float]:
    """Wall seconds of each `work`, the median of `repeats` runs after one that compiles. The rounds alternate between
    them, so that what else the machine does falls on all alike. A `work` returns what it computes, which is evaluated
    within its time."""
    for run in work.values():
        _timed(run)
    rounds = [{name: _timed(run) for name, run in work.items()} for _ in range(repeats)]
    return {name: pick(r[name] for r in rounds) for name in work}


def _timed(run: Callable[[], Any]) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(run())
    dr.sync_thread()
    return time.perf_counter() - start


def seen_points(medium, count: int | None = None) -> shade.Points:
    """Return `count` shading points (default: ``POINTS``) where camera rays meet the field."""
    grid, count = medium.field.grid, count or POINTS
    found = _camera(grid, count)
    lane = dr.arange(mi.UInt32, count) % dr.opaque(mi.UInt32, max(dr.width(found.t), 1))
    ray, t = dr.gather(mi.UInt32, found.ray, lane), dr.gather(mi.Float, found.t, lane)
    x, along = found.place(0, ray, t)
    points = shade.Points(x, tuple(-c for c in along), medium.reflectance(x))
    points.evaluate()
    return points


def _camera(grid, count: int) -> Samples:
    o, d = _rays(grid, count)
    middle = dr.full(mi.Float, 0.5, count)
    strand = Strand(grid, o, d, dr.opaque(mi.Float, 2 / SAMPLES))
    return march.camera_samples([strand], mi.Float(dr.inf), middle, middle)


def _rays(grid, count: int):
    """`count` camera rays, neighbours side by side as pixels are: parallel through a square around the object."""
    side = int(np.sqrt(count))
    low, high = grid.bounds
    index = np.arange(count)
    u, v = (index % side + 0.5) / side, (index // side + 0.5) / (count // side)
    place = np.stack([low[0] + u * (high[0] - low[0]), low[1] + v * (high[1] - low[1]), np.full(count, 3.0)])
    along = np.tile([[0.0], [0.0], [-1.0]], count)
    o, d = (tuple(mi.Float(c) for c in v.astype(np.float32)) for v in (place, along))
    dr.eval(o, d)
    return o, d


def look_up(method, table, x):
    """Σ over the table's lights of τ at `x`."""
    uint = mi.UInt32
    count = dr.opaque(uint, table.count)

    def body(i, total):
        wi, _, distance = table.sample(i, x, True)
        return i + 1, total + method.tau(x, wi, distance, i, mi.Bool(True))

    state = (dr.zeros(uint, dr.width(x)), dr.zeros(mi.Float, dr.width(x)))
    return dr.while_loop(state=state, cond=lambda i, total: i < count, body=body, label="all lights")[1]
