"""Measures the machine's constants of :mod:`mi_ntf.render.cost.model`: seconds of work with the field at hand."""

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import radiosity
from ...infer import march, shade
from ...infer.bundle import Strand
from ...infer.lights import LightTable
from ...infer.samples import Samples
from ...infer.visibility import REGISTRY
from ...infer.visibility.method import Options
from ..cost import model
from ..maps import building
from ..transport import bounced

SAMPLES = 384
WIDTH, RAYS = 1 << 15, 1 << 18
"""Points that lights are looked up at; camera rays, as close together as a picture's: of an eighth as many each took
twice as long, as those of one packet then wait for each other."""
FEW = 4
MANY = 256


def calibrate(medium) -> model.Constants:
    """Constants of this machine, by `medium`'s field; kept in the cache. Takes some seconds, compilation mostly."""
    grid, network = medium.field.grid, medium.field.network
    points, close, many = seen_points(medium), seen_points(medium, RAYS), _table(MANY)
    skin = bounced.skin_of(medium, np.random.default_rng(0))
    jobs = {
        "camera": (lambda: _camera(grid, RAYS).t, RAYS * SAMPLES * _covered(grid) / model.COVERAGE),
        "reflect": (lambda: (grid.reflectance(close.x), medium.field.softness(close.x)), RAYS),
        "shade": (lambda: shade.reflect(points, many, None), WIDTH * MANY),
        "density": (lambda: network.density(points.x), WIDTH),
    }
    if len(skin.position):
        jobs["between"] = lambda: _between(grid, skin), len(skin.position) * radiosity.FEW**2
    for method in REGISTRY.values():
        if method.prices and method.needs(medium):
            jobs |= _jobs(method, medium, points.x)
    found = seconds({name: job for name, (job, _) in jobs.items()}, 5, min)  # other work only adds to them
    result = model.Constants(**{name: 1e9 * value / jobs[name][1] for name, value in found.items()})
    model.remember(result)
    jobs.clear()
    dr.flush_malloc_cache()  # what was built here is not part of a render that follows
    return result


def _jobs(method, medium, x) -> dict:
    """Price → what it is measured by, and how many of its units that are."""
    resolution, lights = method.trial
    few, many = _table(FEW), _table(lights)
    work = model.Work(WIDTH, WIDTH, FEW, method.name, resolution**2, SAMPLES)
    pair, *making = method.prices
    # What is in many maps does not matter to lookups: those are marched in a few steps.
    step = 2 / SAMPLES if lights == FEW else 1 / 4
    built = building.build(method.name, medium, many, Options(step, resolution))
    jobs = {pair: (lambda: look_up(built, many, x), WIDTH * lights * method.pair(work, _alone(pair)))}
    if making:
        def make() -> None:
            building.build(method.name, medium, few, Options(2 / SAMPLES, resolution))

        jobs[making[0]] = make, FEW * method.making(work, _alone(making[0]))
    return jobs


def _alone(name: str) -> model.Constants:
    """Constants of which one is 1 and the others 0: whatever is counted with them is units of it."""
    return model.Constants(**{other: float(other == name) for other in asdict(model.Constants())})


def _table(count: int) -> LightTable:
    """`count` directional lights all around."""
    d = np.random.default_rng(0).normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return table_of(d)


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
    """Return `count` shading points (default: ``WIDTH``) where camera rays meet the field."""
    grid, count = medium.field.grid, count or WIDTH
    found = _camera(grid, count)
    lane = dr.arange(mi.UInt32, count) % dr.opaque(mi.UInt32, max(dr.width(found.t), 1))
    ray, t = dr.gather(mi.UInt32, found.ray, lane), dr.gather(mi.Float, found.t, lane)
    x, along = found.place(0, ray, t)
    points = shade.Points(x, tuple(-c for c in along), medium.reflectance(x))
    points.evaluate()
    return points


def _covered(grid) -> float:
    """The share of the camera rays that meet the field: the others cost next to nothing."""
    return len(np.unique(np.array(_camera(grid, WIDTH).ray))) / WIDTH


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
    return dr.while_loop(state=state, cond=lambda i, total: i < count, body=body, label="calibration")[1]


def _between(grid, skin) -> None:
    """Rays from each patch of the `skin`."""
    rng = np.random.default_rng(0)
    bounced.meet(grid, *radiosity.rays(skin.position, skin.normal, radiosity.FEW, rng), rng)
