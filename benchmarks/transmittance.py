"""Time and error of the learned transmittance: one scene, its field, 50 directional lights.

    python -m benchmarks.transmittance [SCENE.xml ...] [--size 128] [--spp 4] [--lights 50]

Per scene: relative RMSE of the image lit through `ray_network`, and through maps of 128² and 256² texels made
by field and network, against `raymarch` on the same field; and nanoseconds a query of the network on random rays, the
median of five runs of a million after a warm-up.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.table import Table

from mi_ntf.core import variants
from mi_ntf.core.spheres import fibonacci
from mi_ntf.evaluate.metrics import relative_rmse

VARIANTS: dict[str, dict[str, Any]] = {
    "ray_network": {"visibility": "ray_network"},
    "map, field, 128²": {"visibility": "transmittance_map", "map_resolution": 128},
    "map, field, 256²": {"visibility": "transmittance_map", "map_resolution": 256},
    "map, network, 128²": {"visibility": "transmittance_map", "map_source": "network", "map_resolution": 128},
    "map, network, 256²": {"visibility": "transmittance_map", "map_source": "network", "map_resolution": 256},
}


def with_lights(scene, count: int):
    """The field and the view of `scene` under `count` directional lights."""
    parts = {"type": "scene", "sensor": scene.sensors()[0]}
    parts |= {f"shape{i}": shape for i, shape in enumerate(scene.shapes())}
    for i, d in enumerate(fibonacci(count)):
        parts[f"light{i}"] = {"type": "directional", "direction": list(-d), "irradiance": 1.0}
    return mi.load_dict(parts)


def study(path: Path, size: int, spp: int, count: int) -> dict[str, float]:
    """Relative RMSE per variant, and ``ns``, nanoseconds a query."""
    from mi_ntf.render.scene.media import find_media

    scene = with_lights(mi.load_file(str(path), res=str(size)), count)
    images = {}
    for name, options in ({"raymarch": {"visibility": "raymarch"}} | VARIANTS).items():
        integrator = mi.load_dict({"type": "nrf", "hide_emitters": True, **options})
        images[name] = np.array(mi.render(scene, integrator=integrator, spp=spp))[..., :3]
    truth = images.pop("raymarch")
    result = {k: relative_rmse(v, truth) for k, v in images.items()}
    return result | {"ns": query_time(find_media(scene)[0])}


def query_time(medium, count: int = 1 << 20) -> float:
    """Nanoseconds per ray of the network's query, features included, on chords that meet the field's bounds."""
    from mi_ntf.infer.profile import FOR_NETWORKS, DepthProfile

    rng = np.random.default_rng(0)
    way = rng.normal(size=(3, count))
    way /= np.linalg.norm(way, axis=0)
    low, high = medium.field.grid.bounds
    place = (low + rng.uniform(size=(count, 3)) * (high - low)).T
    x, d = (tuple(mi.Float(c.astype(np.float32)) for c in v) for v in (place, way))
    profile = DepthProfile(medium.source, dr.opaque(mi.Float, FOR_NETWORKS * 2 / 384))
    times = []
    for _ in range(6):
        start = time.perf_counter()
        _, _, mixture = medium.field.network.ray_mixture(x, d, profile)
        dr.eval(mixture)
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:]) / count * 1e9


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    scenes = Path(__file__).parents[1] / "scenes"
    parser.add_argument("scenes", nargs="*", type=Path,
                        default=[scenes / n / "scene.xml" for n in ("statue", "globe", "knot")])
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--lights", type=int, default=50)
    options = parser.parse_args()
    mi.set_variant(*variants.VARIANTS)
    from mi_ntf import render

    render.register()
    table = Table("scene", *VARIANTS, "ns a query", title=f"relative RMSE against raymarch, {options.lights} lights")
    for path in options.scenes:
        found = study(path, options.size, options.spp, options.lights)
        table.add_row(path.parent.name, *(f"{found[k]:.1%}" for k in VARIANTS), f"{found['ns']:.0f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
