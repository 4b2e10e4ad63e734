"""Times: those of the paper's networks by the parts of ``mi-ntf bench``, and of maps and volumes built for our scenes.

A network query costs the same whatever it answers, so the parts are measured in small and composed, as in
:mod:`benchmarks.bench_culled`; whole, the volume's side would take days.
"""

from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ntf.core import spheres
from mi_ntf.render import user_cache
from mi_ntf.render.maps import building

from .. import bench, bench_culled, bench_image, bench_paper, bench_product
from ..bench_measure import Sizes as BenchSizes
from ..loops import seconds, table_of
from ..photographs import field_ball
from . import paper
from .compared import Scene, Sizes

Costs = dict[str, float]
MAP = "map", False
"""Networks of the paper's size, all queries asked on both sides, as in the paper …"""
OURS = "ours", True
"""… and our network, empty space left out on both sides."""


def measure(sizes: BenchSizes) -> dict:
    """Row of the job: ``costs`` of :func:`benchmarks.bench_paper.costs_of` and ``machine``."""
    with user_cache.switched("off"):
        scene = bench_image.under_sky(sizes.image)
        costs = bench_paper.costs_of(scene, bench_image.medium_of(scene), sizes)
    return {"costs": {name: float(value) for name, value in costs.items()}, "machine": bench.machine()}


def scaling(sizes: BenchSizes) -> dict:
    """Row of the job: seconds of whole pictures by ``transmittance_map`` under 1 to 500 lights, ``pixels`` a side."""
    with user_cache.switched("off"):
        found = next(r for r in bench_product.scaling_rows(sizes) if "intercept_seconds" in r.details)
    return {"pixels": sizes.image, **{k: found.details[k] for k in ("lights", "seconds", "intercept_seconds")}}


def build(scene: Scene, sizes: Sizes) -> dict:
    """Row of the job: seconds to make the maps (by the network) and the volumes of 1, 2, … lights of a shipped field,
    the median of rounds after one that compiles."""
    ball: Any = mi.load_dict(field_ball(scene.field))
    medium = ball.interior_medium()
    found: dict[str, list[float]] = {"map": [], "volume": []}
    options = {"map": building.Options(2 / 384, sizes.map_resolution, "network"),
               "volume": building.Options(2 / 384, sizes.map_resolution)}
    for count in sizes.build:
        table = table_of(spheres.fibonacci(max(count, 2))[:count])

        def make(kind: str, table=table) -> None:
            building.build(f"transmittance_{kind}", medium, table, options[kind])

        times = seconds({kind: partial(make, kind) for kind in found}, 3)
        for kind, value in times.items():
            found[kind].append(value)
    return {"resolution": sizes.map_resolution, "lights": list(sizes.build), **found}


def transmittance(costs: Costs, lights, table: str, culled: bool, texels: int = paper.SIDE**2) -> tuple:
    """Seconds of the transmittance stage: ``(map, volume)``; `lights`: a number or an array; `texels`: rays a light."""
    rays, voxels = lights * texels, culled * costs["voxels"]
    one, other = (bench_culled.table_seconds(costs, t, culled) for t in (table, f"volume/{paper.SAMPLES}"))
    return rays * one + voxels, rays * other + voxels


def overall(costs: Costs, sizes: BenchSizes, lights, table: str, culled: bool) -> tuple:
    """Seconds of the whole 600² picture: ``(map, volume)``; `lights`: a number or an array."""
    kind = (bench_culled.CULLED if culled else bench_culled.UNCULLED) + (
        ", our network" if table == "ours" else ", paper's network")
    row = next(r for r in bench_culled.image_rows(costs, sizes) if f"m = {paper.SIDE}²" in r.what
               and r.what.endswith(kind))
    d = row.details
    return tuple(d[f"{k}_fixed_seconds"] + np.asarray(lights) * d[f"{k}_lights_seconds"] for k in ("map", "volume"))


def queries(lights: int, texels: int, samples: int, pixels: int) -> dict[str, float]:
    """Queries of the transmittance, by the formulas of :data:`.paper.COMPLEXITY`; AG by the camera's pixels."""
    return {"Naive": lights * samples**2 * pixels, "NRF": lights * texels * samples,
            "AG": lights * pixels * samples, "TM": lights * texels}


def query_seconds(costs: Costs) -> dict[str, float]:
    """Seconds of one of them, networks of the paper's size: of the density for Naive and NRF, of the ray for the
    others."""
    density = costs[f"volume/{paper.SAMPLES}"] / paper.SAMPLES
    return {"Naive": density, "NRF": density, "AG": costs["map"], "TM": costs["map"]}
