"""How bright a relit field is beside the path-traced meshes that it was learned from.

    python -m benchmarks.brightness MESH.xml FIELD [--size 96] [--depth 2]

Both under a flash at the camera, a lamp, a sun, a constant environment and one of high contrast: mean brightness of the
field over the meshes' − 1, relative RMSE as it is and after one factor a channel. `--depth`: ``max_depth`` of both; for
others than 2 also what the bounces beyond the first add to the mean, of the field and of the meshes.
"""

import argparse
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.table import Table

from mi_ntf.core.variants import VARIANTS
from mi_ntf.evaluate import metrics

from .photographs import field_ball

SPP = {"mesh": 256, "field": 16}
CELLS = 256
"""Lights that stand for an environment."""


def lights(scene) -> dict[str, dict]:
    """Name → emitter. The lamp and the sun stand where a viewer of the sphere around `scene` sees long shadows."""
    camera = np.array(scene.sensors()[0].world_transform().translation()).ravel()
    box = scene.bbox()
    centre, radius = np.array(box.center()), np.linalg.norm(np.array(box.extents())) / 2
    distance = float(np.linalg.norm(camera - centre))
    sky = np.full((16, 32, 3), 0.1, np.float32)
    sky[4:6, 20:23] = 20, 18, 15
    sky[6:8, 4:9] = 2, 3, 5
    bitmap = mi.Bitmap(sky)
    lamp = (centre + radius * np.array([1.4, 1.8, 2.7])).tolist()
    return {
        "flash": {"type": "point", "position": camera.tolist(), "intensity": distance**2},
        "lamp": {"type": "point", "position": lamp, "intensity": (3 * radius) ** 2},
        "sun": {"type": "directional", "direction": [1, -1.2, -0.7], "irradiance": 3.0},
        "constant": {"type": "constant", "radiance": 1.0},
        "sky": {"type": "envmap", "bitmap": bitmap},
    }


def study(mesh: Path, field: Path, size: int = 96, depth: int = 2) -> dict[str, dict[str, float]]:
    """Light → ``brightness``, ``relative_rmse``, ``aligned``; where `depth` is not 2, ``bounces`` and
    ``mesh_bounces``."""
    original = mi.load_file(str(mesh), res=str(size))
    bodies = {"mesh": {f"shape{i}": s for i, s in enumerate(original.shapes())}, "field": {"ball": field_ball(field)}}
    sensor, found = original.sensors()[0], {}

    def image(kind: str, light: dict, depth: int) -> np.ndarray:
        own: dict[str, Any] = {"type": "path"} if kind == "mesh" else {"type": "nrf", "environment_lights": CELLS}
        integrator = {**own, "max_depth": depth, "hide_emitters": True}
        scene = mi.load_dict({"type": "scene", "integrator": integrator, "light": light, **bodies[kind]})
        return np.array(mi.render(scene, sensor=sensor, spp=SPP[kind]), np.float64)[..., :3]

    for name, light in lights(original).items():
        truth, ours = (image(kind, light, depth) for kind in bodies)
        found[name] = {"brightness": float(ours.mean() / truth.mean() - 1),
                       "relative_rmse": metrics.relative_rmse(ours, truth),
                       "aligned": metrics.relative_rmse(ours * metrics.alignment(ours, truth), truth)}  # fmt: skip
        if depth != 2:
            for key, whole, kind in (("mesh_bounces", truth, "mesh"), ("bounces", ours, "field")):
                found[name][key] = float(whole.mean() / image(kind, light, 2).mean() - 1)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.brightness", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("field", type=Path)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--depth", type=int, default=2)
    given = parser.parse_args()
    mi.set_variant(*VARIANTS)
    from mi_ntf import render

    render.register()
    titles = {"brightness": "mean brightness", "relative_rmse": "relative RMSE", "aligned": "aligned"}
    if given.depth != 2:
        titles |= {"bounces": "bounces add", "mesh_bounces": "to the meshes"}
    table = Table("light", *titles.values())
    for name, row in study(given.mesh, given.field, given.size, given.depth).items():
        table.add_row(name, *(f"{row[k]:{'+' if k == 'brightness' else ''}.1%}" for k in titles))
    Console().print(table)


if __name__ == "__main__":
    main()
