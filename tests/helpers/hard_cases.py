"""Helpers of the catalogue of hard cases: its table, visibility methods on a field."""

from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from helpers import volumes
from helpers.jit import arrays
from mi_ntf.infer.grid import baked as grid_of
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.network import MIN_DENSITY, NetworkField
from mi_ntf.infer.skin import measured
from mi_ntf.infer.visibility import REGISTRY, outside
from mi_ntf.render.maps import building

SCENES = Path(__file__).parents[2] / "scenes"
PROPERTY = "hard case"
TITLES = ("case", "method", "value checked", "error", "allowed", "result")


def table(rows) -> str:
    """Rows (case, method, value, error, allowed, whether it holds) as text in columns."""
    lines = [TITLES] + [(*row[:-1], "ok" if row[-1] else "OPEN") for row in rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(TITLES))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([text[0], "-" * (sum(widths) + 2 * len(widths)), *text[1:]])


METHODS = {
    "raymarch": ("raymarch", {}),
    "transmittance_volume": ("transmittance_volume", {}),
    "transmittance_map": ("transmittance_map", {}),
    "transmittance_map, 2 logistics": ("transmittance_map", {"map_components": 2}),
    "transmittance_map, network": ("transmittance_map", {"map_source": "network"}),
    "transmittance_atlas": ("transmittance_atlas", {}),
    "neural_transmittance": ("neural_transmittance", {}),
    "ray_network": ("ray_network", {}),
    "visibility_mlp": ("visibility_mlp", {}),
}
"""What users can choose: name in the table → method and options. Networks are those of the field's file."""
MARCHED = ("raymarch", "transmittance_volume", "transmittance_map", "transmittance_map, 2 logistics")
"""Methods that follow the field itself, whatever its networks say."""


def baked(header, tensors, resolution: int = 192):
    """A field as a render holds it: stands for a medium whose frame is the identity."""
    network = NetworkField(header, tensors, mi)
    grid = grid_of(network, resolution, mi)
    field = SimpleNamespace(network=network, grid=grid, softness=measured(grid, mi), trained=True)
    return SimpleNamespace(source=grid, field=field)


def seen_from(x: np.ndarray, light) -> tuple:
    """``(wi, distance)`` of the light at the points `x` (n, 3). `light`: a position and True, a direction and False."""
    where, is_point = np.asarray(light[0], np.float64), light[1]
    d = where - x if is_point else np.broadcast_to(where, x.shape)
    r = np.linalg.norm(d, axis=1)
    return d / np.maximum(r, 1e-300)[:, None], r if is_point else np.full(len(x), np.inf)


_atlases: dict = {}


def atlas(name: str, medium):
    """Made in seconds, and the same for all lights: the last one is kept."""
    if (name, id(medium)) not in _atlases:
        _atlases.clear()
        _atlases[name, id(medium)] = medium, building.build(name, medium, None, building.Options(2 / 384))
    return _atlases[name, id(medium)][1]


def transmittance(method: str, medium, light, x: np.ndarray) -> np.ndarray:
    """τ (n,) of one light at the points `x`, field coordinates, by a method of METHODS with the renderer's defaults."""
    name, options = METHODS[method]
    table = LightTable([light[0]], np.ones((1, 3)), [light[1]], 1.0, mi)
    options = building.Options(2 / 384, **options)
    found = atlas(name, medium) if REGISTRY[name].per_field else building.build(name, medium, table, options)
    wi, distance = seen_from(x, light)
    active = dr.full(mi.Bool, True, len(x))
    tau = outside.tau(found, arrays(x), arrays(wi), mi.Float(distance), mi.UInt32(0), active)
    return np.array(tau, np.float64)


def marched(grid, x: np.ndarray, light: np.ndarray, step: float = 1 / 1024) -> np.ndarray:
    """τ (n,) from the points `x` towards the direction `light`, in float64: the voxels' ln σ, trilinear, every `step`
    to the end of the unit sphere."""
    log_sigma = volumes.voxels(grid.bricks)[..., 0].astype(np.float64)
    n = len(log_sigma)
    along = x @ light
    length, depth = np.sqrt(np.maximum(along**2 - (x * x).sum(1) + 1, 0)) - along, np.zeros(len(x))
    for k in range(int(2 / step)):
        t = (k + 0.5) * step
        p = x + t * light
        sigma = np.exp(map_coordinates(log_sigma, ((p[:, ::-1] + 1) * n / 2 - 0.5).T, order=1, mode="nearest"))
        depth += np.where((t < length) & (sigma > MIN_DENSITY), sigma, 0) * step
    return np.exp(-depth)
