"""Measures the machine's constants of :mod:`mi_ntf.render.cost.model`: seconds of work with the field at hand."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import radiosity
from ...infer import march, shade
from ...infer.bundle import Strand
from ...infer.lights import LightTable
from ...infer.visibility.transmittance_volume import ENTRIES
from ..cost import model
from ..maps import building
from ..transport import bounced

SAMPLES = 384
WIDTH = 1 << 15
MAP = 128
FEW = 4
MANY = 256
"""Lights of the lookups: their maps fit no cache, and neither do a scene's."""
VOLUME = 52
"""Rays along a volume's side: fewer, since each has more than an entry for each sample."""


def calibrate(medium) -> model.Constants:
    """Constants of this machine, by `medium`'s field; kept in the cache. Takes some seconds, compilation mostly."""
    grid, network = medium.field.grid, medium.field.network
    few, many = _table(FEW), _table(MANY)
    options, small = building.Options(2 / SAMPLES, MAP), building.Options(2 / SAMPLES, VOLUME)
    # What is in a map does not matter to lookups: this one is marched in a few steps.
    methods = {name: (building.build(name, medium, table, o), table) for name, table, o in (
        ("raymarch", few, options), ("transmittance_map", many, building.Options(1 / 4, MAP)),
        ("transmittance_volume", few, small), ("neural_transmittance", few, options))}
    if medium.field.header.architecture.visibility is not None:
        methods["visibility_mlp"] = building.build("visibility_mlp", medium, few, options), few
    points = _points(medium)
    work = {name: (lambda pair=pair: _tau(*pair, points.x)) for name, pair in methods.items()}
    work |= {"map": lambda: building.build("transmittance_map", medium, few, options).values,
             "volume": lambda: building.build("transmittance_volume", medium, few, small).values,
             "camera": lambda: _camera(grid).t,
             "reflect": lambda: [*_flat(grid.reflectance(points.x)), medium.field.softness(points.x)],
             "shade": lambda: shade.reflect(points, many, None), "density": lambda: network.density(points.x)}
    skin = bounced.Skin(medium, np.random.default_rng(0))
    if len(skin.position):
        work["between"] = lambda: _between(grid, skin)
    found = seconds(work, 5, min)  # the machine's own prices: other work only adds to them
    pairs = {name: WIDTH * pair[1].count for name, pair in methods.items()}
    samples = FEW * model.FILLED * SAMPLES
    counts = pairs | {"map": MAP**2 * samples, "volume": VOLUME**2 * ENTRIES * samples,
                      "camera": WIDTH * SAMPLES, "reflect": WIDTH, "shade": WIDTH * MANY, "density": WIDTH,
                      "between": len(skin.position) * radiosity.FEW**2}
    ns = {name: 1e9 * value / counts[name] for name, value in found.items()}
    result = model.Constants(
        camera=ns["camera"], reflect=ns["reflect"], shade=ns["shade"], texel=ns["map"], cell=ns["volume"],
        march=ns["raymarch"] / model.light_steps(SAMPLES), lookup=ns["transmittance_map"],
        fetch=ns["transmittance_volume"], density=ns["density"], ray=ns["neural_transmittance"],
        mlp=ns.get("visibility_mlp", model.Constants().mlp), between=ns.get("between", model.Constants().between),
    )
    model.remember(result)
    return result


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


def _points(medium) -> shade.Points:
    """Where random camera rays meet the field, WIDTH points."""
    grid = medium.field.grid
    found = _camera(grid)
    lane = dr.arange(mi.UInt32, WIDTH) % dr.opaque(mi.UInt32, max(dr.width(found.t), 1))
    ray, t = dr.gather(mi.UInt32, found.ray, lane), dr.gather(mi.Float, found.t, lane)
    x, along = found.place(0, ray, t)
    points = shade.Points(x, tuple(-c for c in along), medium.reflectance(x))
    points.evaluate()
    return points


def _camera(grid) -> march.Samples:
    o, d = _rays(grid)
    middle = dr.full(mi.Float, 0.5, WIDTH)
    strand = Strand(grid.density, grid, o, d, dr.opaque(mi.Float, 2 / SAMPLES))
    return march.camera_samples([strand], mi.Float(dr.inf), middle, middle)


def _rays(grid):
    """WIDTH camera rays, neighbours side by side as pixels are: parallel through a square around the object."""
    side = int(np.sqrt(WIDTH))
    low, high = grid.bounds
    index = np.arange(WIDTH)
    u, v = (index % side + 0.5) / side, (index // side + 0.5) / (WIDTH // side)
    o = np.stack([low[0] + u * (high[0] - low[0]), low[1] + v * (high[1] - low[1]), np.full(WIDTH, 3.0)])
    o, d = (tuple(mi.Float(c) for c in v.astype(np.float32)) for v in (o, np.tile([[0.0], [0.0], [-1.0]], WIDTH)))
    dr.eval(o, d)
    return o, d


def _tau(method, table, x):
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
    bounced.meet(grid.density, grid, *radiosity.rays(skin.position, skin.normal, radiosity.FEW, rng), rng)


def _flat(reflectance) -> list:
    normal, albedo, *rest = reflectance
    return [*normal, *albedo, *rest]
