"""Loops over shading points and lights, and the clock that compares them."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.infer import march, shade
from mi_ntf.infer.bundle import Strand
from mi_ntf.infer.lights import LightTable

SAMPLES = 384
"""Steps across the diameter of the unit sphere: the default of integrators."""
POINTS = 1 << 15
"""Default number of shading points."""


def table_of(where: np.ndarray, is_point: bool = False) -> LightTable:
    """Return lights of power 1 at the points `where` (n, 3), or towards these directions, in field coordinates."""
    return LightTable(where, np.ones((len(where), 3)), np.full(len(where), is_point), 1.0, mi)


def rounds(work: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, list[float]]:
    """Return the wall seconds of each function in each of so many rounds, after a first one that compiles.

    Every round calls every function, so that other work on the machine slows all of them down alike. A function returns
    the arrays that it computes; they are evaluated within its time.
    """
    for function in work.values():
        clock(function)
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(repeats):
        for name, function in work.items():
            times[name].append(clock(function))
    return times


def clock(function: Callable[[], Any]) -> float:
    """Return the wall seconds of a function and of the evaluation of its result."""
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(function())
    dr.sync_thread()
    return time.perf_counter() - start


def seen_points(medium: Any, count: int | None = None) -> shade.Points:
    """Return `count` shading points (default: `POINTS`) where parallel camera rays meet the field."""
    grid, count = medium.field.grid, count or POINTS
    o, d = _rays(grid, count)
    middle = dr.full(mi.Float, 0.5, count)
    strand = Strand(grid, o, d, dr.opaque(mi.Float, 2 / SAMPLES))
    samples = march.camera_samples([strand], mi.Float(dr.inf), middle, middle)
    lane = dr.arange(mi.UInt32, count) % dr.opaque(mi.UInt32, max(dr.width(samples.t), 1))
    ray, t = dr.gather(mi.UInt32, samples.ray, lane), dr.gather(mi.Float, samples.t, lane)
    x, along = samples.place(0, ray, t)
    points = shade.Points(x, tuple(-c for c in along), medium.reflectance(x))
    points.evaluate()
    return points


def _rays(grid: Any, count: int) -> tuple[Any, Any]:
    """Return origins and directions of parallel rays through a square around the object, row by row."""
    side = int(np.sqrt(count))
    low, high = grid.bounds
    index = np.arange(count)
    u, v = (index % side + 0.5) / side, (index // side + 0.5) / (count // side)
    place = np.stack([low[0] + u * (high[0] - low[0]), low[1] + v * (high[1] - low[1]), np.full(count, 3.0)])
    along = np.tile([[0.0], [0.0], [-1.0]], count)
    o, d = (tuple(mi.Float(c) for c in v.astype(np.float32)) for v in (place, along))
    dr.eval(o, d)
    return o, d


def look_up(method: Any, table: LightTable, x: Any) -> Any:
    """Return the sum over the table's lights of the transmittance at the points `x`."""
    uint = mi.UInt32
    count = dr.opaque(uint, table.count)

    def body(i, total):
        light = table.sample(i, x, True)
        return i + 1, total + method.tau(x, light.wi, light.distance, i, mi.Bool(True))

    def more(i: Any, total: Any) -> Any:
        return i < count

    state = (dr.zeros(uint, dr.width(x)), dr.zeros(mi.Float, dr.width(x)))
    return dr.while_loop(state=state, cond=more, body=body, label="all lights")[1]
