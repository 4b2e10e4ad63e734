"""What a lookup of the transmittance map costs, beside the bare memory traffic of one.

    python -m mi_ntf.evaluate.lookup [--points 262144] [--lights 50] [--resolution 128]

Nanoseconds of processor time per point and light (all cores together, so that the machine's other work counts little),
medians of interleaved runs after a warm-up, of a loop over lights that does nothing but sum τ: maps of directional
lights, of point lights outside and inside the field's sphere, of two logistics a texel, and four gathers of (a, b) at
texels that are as scattered (:class:`mi_ntf.evaluate.bench_product.Gathers`). The cost of the empty loop, with its own
fetch of the light, is taken off all of them.
"""

import argparse
import statistics
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from ..infer.lights import LightTable
from . import transmittance
from .bench_product import Gathers


def measure(medium, points: int = 1 << 18, lights: int = 50, resolution: int = 128, repeats: int = 7) -> dict:
    """Nanoseconds by name: ``directional``, ``mixture``, ``point``, ``inside``, ``gathers``; ``loop``, what has been
    taken off."""
    from ..render import visibility

    if points < 1 or lights < 1:
        raise MiNtfError(f"lookup: {points} points and {lights} lights leave nothing to measure; give 1 or more")
    grid = medium.field.grid
    low, high = grid.bounds
    x = (low + np.random.default_rng(0).uniform(size=(points, 3)) * (high - low)).T
    x = tuple(mi.Float(np.ascontiguousarray(c, np.float32)) for c in x)
    d = transmittance.directions(lights)
    tables = {"directional": _table(d, False), "point": _table(2.5 * d, True), "inside": _table(0.5 * d, True)}
    tables["mixture"] = tables["directional"]
    work = {"loop": (tables["directional"], None), "gathers": (tables["directional"], Gathers(lights, resolution))}
    for name, table in tables.items():
        options = visibility.Options(2 / 128, resolution, map_components=2 if name == "mixture" else 1)
        work[name] = table, visibility.build("transmittance_map", medium, table, options)
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(repeats + 1):
        for name, (table, method) in work.items():
            start = time.process_time()
            dr.eval(total(x, table, method))
            dr.sync_thread()
            times[name].append(time.process_time() - start)
    ns = {name: 1e9 * statistics.median(t[1:]) / (points * lights) for name, t in times.items()}
    return {name: value - ns["loop"] * (name != "loop") for name, value in ns.items()}


def total(x, table, method):
    """Σ τ over the lights of `table` at the points `x`, one symbolic loop; without `method` Σ 1."""
    count = dr.opaque(mi.UInt32, table.count)

    def body(i, result):
        wi, irradiance, distance = table.sample(i, x, True)
        tau = 1 if method is None else method.tau(x, wi, distance, i, mi.Bool(True))
        # All that the light's row gives has a use, as in a render.
        return i + 1, result + (tau + 1e-9 * (wi[0] + wi[1] + wi[2])) * irradiance[0]

    zero = dr.zeros(mi.Float, dr.width(x[0]))
    state = (dr.zeros(mi.UInt32, dr.width(zero)), zero)
    return dr.while_loop(state=state, cond=lambda i, result: i < count, body=body, label="lookups")[1]


def _table(where: np.ndarray, point: bool) -> LightTable:
    return LightTable(where, np.ones((len(where), 3)), np.full(len(where), point), 1.0, mi)


def main() -> None:
    """Print the nanoseconds."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--points", type=int, default=1 << 18)
    parser.add_argument("--lights", type=int, default=50)
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--scene", type=Path, default=Path(__file__).parents[2] / "scenes/statue/scene.xml")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    from .. import render
    from ..render import effects

    render.register()
    medium = effects.find_media(mi.load_file(str(options.scene)))[0]
    for name, ns in measure(medium, options.points, options.lights, options.resolution).items():
        print(f"{name:12} {ns:6.2f} ns")


if __name__ == "__main__":
    main()
