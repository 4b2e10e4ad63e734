"""Small pictures of one field, for checks by value: fields on disk, scenes around them, means and derivatives."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from helpers import scenes
from helpers.hard_cases import METHODS
from mi_ntf.core import field_file


def save(folder: Path, field: tuple, name: str = "field") -> Path:
    """`field` (header, tensors) as a file in full precision."""
    path = folder / f"{name}.safetensors"
    field_file.save(path, *field, np.float32)
    return path


def integrator(method: str, **options) -> dict:
    """`method`: one of METHODS, or any name of `visibility`."""
    name, more = METHODS.get(method, (method, {}))
    return {"type": "nrf", "visibility": name, "hide_emitters": True, **more, **options}


def ball(path: Path, **medium) -> dict:
    """The unit sphere that holds the field."""
    return {"type": "sphere", "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(path), **medium}}  # fmt: skip


def camera(origin, target=(0, 0, 0), fov: float = 10.0, size: int = 8, up=(0, 1, 0)) -> dict:
    look = mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))
    return {"type": "perspective", "fov": fov, "to_world": look, "near_clip": 1e-4, "film": scenes.film(size)}


def sun(direction, power: float = 1.0) -> dict:
    """Light from the unit vector `direction`."""
    return {"type": "directional", "direction": [-float(c) for c in direction], "irradiance": power}


def render(method: str, things: dict, spp: int = 16, seed: int = 0, **options) -> np.ndarray:
    """(h, w, 4); `things`: sensor, lights and shapes by name."""
    scene = mi.load_dict({"type": "scene", "integrator": integrator(method, **options), **things})
    return np.array(mi.render(scene, spp=spp, seed=seed), np.float64)


def slope(method: str, things: dict, name: str, spp: int = 16, **options) -> float:
    """Derivative of the mean radiance by the sum of parameter `name`, backwards, with :func:`render`'s random
    numbers."""
    scene = mi.load_dict({"type": "scene", "integrator": integrator(method, **options), **things})
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[name])
    parameters.update()
    image = mi.render(scene, parameters, spp=spp, seed=1, seed_grad=0)
    dr.backward(dr.mean(image[..., :3], axis=None))
    return float(np.sum(np.array(dr.grad(parameters[name]), np.float64)))
