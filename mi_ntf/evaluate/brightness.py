"""How bright a relit field is beside the path-traced meshes that it was learned from.

    python -m mi_ntf.evaluate.brightness MESH.xml FIELD [--size 96] [--depth 2]

Both under a flash at the camera, a lamp, a sun, a constant environment and one of high contrast: mean brightness of the
field over the meshes' − 1, relative RMSE as it is and after one factor a channel. `--depth`: ``max_depth`` of both.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.table import Table

from . import metrics
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
    """Light → ``brightness``, ``relative_rmse``, ``aligned``."""
    original = mi.load_file(str(mesh), res=str(size))
    shapes = {f"shape{i}": s for i, s in enumerate(original.shapes())}
    sensor, found = original.sensors()[0], {}
    for name, light in lights(original).items():
        images = {}
        for kind, parts in (("mesh", shapes), ("field", {"ball": field_ball(field)})):
            integrator = {"type": "path" if kind == "mesh" else "nrf", "max_depth": depth, "hide_emitters": True}
            if kind == "field":
                integrator["environment_lights"] = CELLS
            scene = mi.load_dict({"type": "scene", "integrator": integrator, "light": light, **parts})
            images[kind] = np.array(mi.render(scene, sensor=sensor, spp=SPP[kind]), np.float64)[..., :3]
        ours, truth = images["field"], images["mesh"]
        found[name] = {"brightness": float(ours.mean() / truth.mean() - 1),
                       "relative_rmse": metrics.relative_rmse(ours, truth),
                       "aligned": metrics.relative_rmse(ours * metrics.alignment(ours, truth), truth)}  # fmt: skip
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m mi_ntf.evaluate.brightness", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("field", type=Path)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--depth", type=int, default=2)
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    from .. import render

    render.register()
    table = Table("light", "mean brightness", "relative RMSE", "aligned")
    for name, row in study(given.mesh, given.field, given.size, given.depth).items():
        table.add_row(name, f"{row['brightness']:+.1%}", f"{row['relative_rmse']:.1%}", f"{row['aligned']:.1%}")
    Console().print(table)


if __name__ == "__main__":
    main()
