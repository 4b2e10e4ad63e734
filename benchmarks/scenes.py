"""Shipped scenes under lights of the benchmarks, and pictures of them."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.spheres import fibonacci

SCENES = Path(__file__).parents[1] / "scenes"
NAMES = ("statue", "globe", "knot", "cloud", "skull")
LIGHTS = ("point", "directional", "env", "sky", "area")


def emitter(light: str, name: str, center: np.ndarray, radius: float) -> dict[str, Any]:
    """Return the Mitsuba dict of one of `LIGHTS`, as bright and in the same direction as the scene's own point light.

    ``sky`` has a sun of half a degree. The world of the scene ``skull`` is upside down.
    """
    up = -1.0 if name == "skull" else 1.0
    direction = np.array([1.4, 1.8 * up, 2.7 if name != "skull" else -2.0])
    direction /= np.linalg.norm(direction)
    distance = 3.2 * radius
    place, power = center + distance * direction, math.pi * distance**2
    if light == "point":
        return {"type": "point", "position": place.tolist(), "intensity": power}
    if light == "directional":
        return {"type": "directional", "direction": (-direction).tolist(), "irradiance": math.pi}
    if light == "env":
        return {"type": "envmap", "filename": str(SCENES / "common" / "env.exr")}
    if light == "area":
        size = 0.3 * radius
        return {"type": "sphere", "center": place.tolist(), "radius": size,
                "light": {"type": "area", "radiance": power / (math.pi * size**2)}}
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], -90 * up)
    return {"type": "sunsky", "sun_direction": direction.tolist(), "to_world": upright}


def field_ball(field: Path) -> dict[str, Any]:
    """Return the Mitsuba dict of a field in its unit sphere, where it was captured."""
    similarity = field_file.load_header(field).similarity
    return {"type": "sphere", "center": list(similarity.center), "radius": similarity.radius, "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(field)}}


def scene(name: str, light: str, size: int, spp: int) -> Any:
    """Return a shipped scene with its own camera under one of `LIGHTS`, with `size`² pixels."""
    loaded = mi.load_file(str(SCENES / name / "scene.xml"), res=str(size), spp=str(spp))
    ball = field_ball(SCENES / name / "field.safetensors")
    lamp = emitter(light, name, np.array(ball["center"], float), float(ball["radius"]))
    return mi.load_dict({"type": "scene", "sensor": loaded.sensors()[0], "ball": ball, "light": lamp})


def statue(size: int, light: dict[str, Any] | Callable[[np.ndarray], dict[str, Any]]) -> Any:
    """Return the scene ``statue`` with `size`² pixels under an emitter's dict, or a function from camera to dict."""
    path = SCENES / "statue" / "scene.xml"
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; run the benchmark in a checkout, which has scenes/")
    loaded: Any = mi.load_file(str(path), res=str(size), spp="1")
    sensor = loaded.sensors()[0]
    if callable(light):
        light = light(np.array(sensor.world_transform().translation()).ravel())
    return mi.load_dict({"type": "scene", "sensor": sensor, **_shapes(loaded), "light": light})


def under_sky(size: int, columns: int = 1, rows: int = 1) -> Any:
    """Return the scene ``statue`` under `columns` × `rows` texels of the shipped environment."""
    return statue(size, {"type": "envmap", "bitmap": mi.Bitmap(sky(columns, rows))})


def sky(columns: int, rows: int) -> np.ndarray:
    """Return the nearest pixels of the shipped environment (rows, columns, 3), linear RGB."""
    image = np.array(mi.Bitmap(str(SCENES / "common" / "env.exr")), np.float32)[..., :3]
    v = ((np.arange(rows) + 0.5) / rows * image.shape[0]).astype(int)
    u = ((np.arange(columns) + 0.5) / columns * image.shape[1]).astype(int)
    return np.ascontiguousarray(image[v][:, u])


def with_lights(loaded: Any, count: int) -> Any:
    """Return the fields and the camera of a scene under `count` directional lights all around."""
    lights = {f"light{i}": {"type": "directional", "direction": list(-d), "irradiance": 1.0}
              for i, d in enumerate(fibonacci(count))}
    return mi.load_dict({"type": "scene", "sensor": loaded.sensors()[0], **_shapes(loaded), **lights})


def _shapes(loaded: Any) -> dict[str, Any]:
    return {f"shape{i}": shape for i, shape in enumerate(loaded.shapes())}


def medium_of(loaded: Any) -> Any:
    """Return the first ``nrf`` medium of a scene."""
    return next(m for s in loaded.shapes() if getattr(m := s.interior_medium(), "is_nrf", False))


def integrator(**properties: Any) -> Any:
    """Return an integrator ``nrf`` that leaves emitters out of the picture."""
    return mi.load_dict({"type": "nrf", "hide_emitters": True, **properties})


def picture(loaded: Any, nrf: Any, seed: Any = 0, spp: int = 0) -> tuple[np.ndarray, float]:
    """Return a picture (h, w, 3) and the seconds that it took."""
    dr.sync_thread()
    start = time.perf_counter()
    image = np.array(mi.render(loaded, integrator=nrf, seed=seed, spp=spp), np.float64)[..., :3]
    return image, time.perf_counter() - start
