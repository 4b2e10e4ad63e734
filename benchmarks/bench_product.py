"""The shipped statue, rendered as users render it: whole images, many lights, one lookup, the map's error."""

import statistics
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import spheres
from mi_ntf.evaluate import metrics
from mi_ntf.infer import shade

from . import bench_image, transmittance
from .bench_measure import Row, Sizes, row
from .loops import seconds, table_of


def many_lights_rows(sizes: Sizes) -> list[Row]:
    """Time and peak memory under the large environment."""
    columns, rows = sizes.many
    found = bench_image.in_own_process(sizes.image, columns, rows, 1)
    what = f"{sizes.image}² image, transmittance_map, {columns}×{rows} environment ({columns * rows} lights)"
    details = {"seconds": found["seconds"], "process": "its own, after a small render that compiles"}
    return [row(what, found["seconds"][-1], "s", most=200, details=details),
            row(what + ", peak memory", found["peak_bytes"] / 2**30, "GiB", most=4)]


def first_rows(sizes: Sizes) -> list[Row]:
    """The first picture of a process: without kernels and maps of earlier ones, and with them."""
    columns, rows = sizes.lights[-1]
    with tempfile.TemporaryDirectory() as home:
        found = {name: bench_image.in_own_process(sizes.image, columns, rows, 1, Path(home))
                 for name in ("cold caches", "kernels and maps at hand")}
    what = f"{sizes.image}² image, transmittance_map, {columns * rows} lights, first picture of a process, "
    result = []
    for name, f in found.items():
        details = {"process_seconds": f["process_seconds"], "process": "Python, the field baked, the picture"}
        result.append(row(what + name, f["seconds"][0], "s", details=details))
    return result


def scaling_rows(sizes: Sizes) -> list[Row]:
    """The image under 1 to 500 lights: the last alone, and the line through all."""
    counts, times = [], []
    for columns, rows in sizes.lights:
        nrf = bench_image.integrator(columns, rows)
        lit = bench_image.under_sky(sizes.image, columns, rows)
        counts.append(columns * rows)
        times.append(statistics.median(bench_image.timed(lit, nrf, min(sizes.repeats, 3))))
    slope, intercept = np.polyfit(counts, times, 1)
    fit = slope * np.array(counts) + intercept
    spread = float(np.abs(np.array(times) - fit).max() / max(times))
    details = {"lights": counts, "seconds": times, "intercept_seconds": float(intercept), "worst_residual": spread}
    image = f"{sizes.image}² image, transmittance_map, "
    return [
        row(image + f"{counts[-1]} lights", times[-1], "s", most=12, details={"lights": counts[-1]}),
        Row(image + f"time per light, {counts[0]} to {counts[-1]} lights (intercept {intercept:.2f} s)",
            1e3 * float(slope), "ms", "linear", met=spread < 0.1, details=details),
    ]


def collocated_rows(sizes: Sizes) -> list[Row]:
    """A point light at the camera and nothing else, against the same light just not there, which takes the general
    path: a march for each shading point, or a map."""
    def at(share):
        return bench_image.load(sizes.image, lambda camera: {
            "type": "point", "position": list(camera * (1 + share)), "intensity": 30.0})

    cases = {"collocated": (at(0), "raymarch"), "raymarch": (at(0.02), "raymarch"),
             "map": (at(0.02), "transmittance_map")}
    work: dict[str, Callable[[], Any]] = {}
    for name, (scene, method) in cases.items():
        nrf = mi.load_dict({"type": "nrf", "visibility": method, "samples": bench_image.SAMPLES})
        work[name] = partial(mi.render, scene, integrator=nrf, spp=1)
    found = seconds(work, sizes.repeats)
    what = f"{sizes.image}² image, one light at the camera, speed-up over "
    return [row(what + "a march for each point", found["raymarch"] / found["collocated"], "×", least=3, details=found),
            row(what + "a map", found["map"] / found["collocated"], "×")]


def lookup_rows(medium, sizes: Sizes) -> list[Row]:
    """Nanoseconds a point and light of the shading loop with the map, less the loop without, by kinds of lights and
    maps; beside four bare gathers."""
    from mi_ntf.render.maps import building

    count, width = 10 * sizes.slow_lights, max(1 << 10, sizes.queries // 4)
    points, d = _inside(medium, width), spheres.fibonacci(count)
    tables = {"": table_of(d), " of a point light": table_of(2.5 * d, True),
              " of a light inside the sphere": table_of(0.5 * d, True)}
    tables[" of two logistics"] = tables[""]
    work = {"gathers": lambda: shade.reflect(points, tables[""], Gathers(count, sizes.map))}
    for name, table in tables.items():
        options = building.Options(2 / 384, sizes.map, map_components=2 if "two" in name else 1)
        tmap = building.build("transmittance_map", medium, table, options)
        work |= {f"map{name}": partial(shade.reflect, points, table, tmap),
                 f"none{name}": partial(shade.reflect, points, table, _Everything())}
    found = seconds(work, max(sizes.repeats, 3))
    ns = {k: 1e9 * v / (width * count) for k, v in found.items()}
    gather = ns["gathers"] - ns["none"]
    rows = [Row("four bare gathers where a map is looked up, per point and light", gather, "ns")]
    for name in tables:
        lookup = ns[f"map{name}"] - ns[f"none{name}"]
        asked: dict[str, Any] = {} if name else {
            "asked": "≤ 8 ns, or ≤ 2 × four gathers", "met": lookup <= 8 or lookup <= 2 * gather,
            "details": {k + "_ns": v for k, v in ns.items()},
        }
        rows.append(Row(f"lookup of a map{name} in the shading loop, per point and light", lookup, "ns", **asked))
    return rows


def _inside(medium, count: int) -> shade.Points:
    """`count` shading points anywhere in the box around the object."""
    low, high = medium.field.grid.bounds
    x = _floats(low + np.random.default_rng(0).uniform(size=(count, 3)) * (high - low))
    wo = tuple(dr.full(mi.Float, c, count) for c in (0.0, 0.6, 0.8))
    points = shade.Points(x, wo, medium.reflectance(x))
    points.evaluate()
    return points


class _Everything:
    """A visibility that costs nothing, in the place of one that does."""

    def tau(self, x, wi, distance, index, active):
        return dr.select(active, mi.Float(1), 0)


class Gathers:
    """The memory traffic of a map of one logistic, and nothing else of it: the pairs of the four nearest texels."""

    def __init__(self, lights: int, m: int):
        self.m = dr.opaque(mi.UInt32, m)
        self.values = dr.opaque(mi.Float, 1, lights * m * m * 2)  # a literal would be folded into the kernel

    def tau(self, x, wi, distance, index, active):
        """The mean of the four pairs' first entries: 1."""
        last = mi.Float(self.m) - 2
        u = mi.UInt32(dr.clip((0.5 * (x[0] * wi[1] - x[1] * wi[0]) + 0.5) * last, 0, last))
        v = mi.UInt32(dr.clip((0.5 * x[2] + 0.5) * last, 0, last))
        first = (mi.UInt32(index) * self.m + v) * self.m + u
        pairs = [dr.gather(mi.Array2f, self.values, first + k, active) for k in (0, 1, self.m, self.m + 1)]
        return 0.125 * sum(p[0] + p[1] for p in pairs)


def error_rows(scene, sizes: Sizes) -> list[Row]:
    """Image error of maps marched from the field, against a fine march."""
    lit = transmittance.with_lights(scene, sizes.error_lights)
    samples: dict[str, Any] = {"samples": 1536, "hide_emitters": True}
    tmap = samples | {"visibility": "transmittance_map", "map_resolution": sizes.error_map}
    kinds = {"fine": samples | {"visibility": "raymarch"}, "logistic": tmap, "mixture": tmap | {"map_components": 2}}
    images = {k: np.array(mi.render(lit, integrator=mi.load_dict({"type": "nrf", **v}), spp=4))[..., :3]
              for k, v in kinds.items()}
    truth = images.pop("fine")
    return [row(f"map_source=field, {sizes.error_map}², {kind}, relative RMSE to a march, 1536 samples, "
                f"{sizes.error_lights} lights", 100 * metrics.relative_rmse(v, truth),
                "%", most={"logistic": 2, "mixture": 1}[kind]) for kind, v in images.items()]


def _floats(points: np.ndarray):
    found = tuple(mi.Float(c) for c in points.T.astype(np.float32))
    dr.eval(found)
    return found
