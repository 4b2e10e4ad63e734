"""Small scenes around a field file, as Mitsuba dicts."""

from pathlib import Path

import mitsuba as mi
import numpy as np

from helpers import fields
from mi_ntf.core import field_file
from mi_ntf.core.architecture import Similarity

# An asymmetric object: no rotation or reflection maps it to itself. Off the origin, so that a lost transform shows.
CENTERS = [(-0.3, 0.05, 0.0), (0.45, 0.3, 0.15), (0.1, -0.5, 0.35)]
RADII = [0.5, 0.28, 0.2]
SIMILARITY = Similarity((0.4, -0.2, 0.3), 1.5)


def write_blobs(folder: Path, **options) -> Path:
    """The asymmetric object as a field file."""
    folder.mkdir(exist_ok=True)
    path = folder / "blobs.safetensors"
    header, tensors = fields.blobs(CENTERS, RADII, similarity=SIMILARITY, **options)
    field_file.save(path, header, tensors, np.float32)
    return path


def light(kind: str) -> dict:
    """Light from the upper right front; `env`: a smooth sky that is brightest there."""
    if kind == "directional":
        return {
            "type": "directional",
            "direction": [-1, -1.2, -0.6],
            "irradiance": {"type": "rgb", "value": [3, 2.5, 2]},
        }
    if kind == "point":
        return {"type": "point", "position": [3.4, 3.0, 2.5], "intensity": {"type": "rgb", "value": [60, 50, 40]}}
    v, u = np.mgrid[:16, :32] / 16
    sky = 0.6 + 0.5 * np.cos(np.pi * (u - 0.65)) * np.sin(np.pi * v) + 0.3 * np.cos(np.pi * v)
    image = (sky[..., None] * [1.0, 0.9, 0.8]).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(image)}


def nrf(visibility="raymarch", **options) -> dict:
    """The integrator, without what shines in the picture."""
    return {"type": "nrf", "visibility": visibility, "hide_emitters": True, **options}


def film(size: int) -> dict:
    """Square RGBA film with a box filter: pixels are independent of each other."""
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgba"}


def ball(field: Path, similarity=SIMILARITY, **medium) -> dict:
    """The object of `field` in a sphere of null BSDF."""
    return {
        "type": "sphere",
        "center": list(similarity.center),
        "radius": similarity.radius,
        "bsdf": {"type": "null"},
        "interior": {"type": "nrf", "filename": str(field), **medium},
    }


def scene(
    field: Path | None,
    integrator: dict,
    lights: dict,
    *,
    size=64,
    spp=16,
    medium=None,
    shapes=None,
    sampler="independent",
    film_options=None,
):
    """The object in a sphere of null BSDF, seen from the front; `lights`: name → emitter dict; `film_options`: beside
    those of :func:`film`."""
    to_world = mi.ScalarTransform4f
    center = list(SIMILARITY.center)
    look = to_world().look_at(origin=[center[0] + 1.2, center[1] + 1.5, center[2] + 5], target=center, up=[0, 1, 0])
    result = {
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "perspective",
            "fov": 28,
            "to_world": look,
            "film": {**film(size), **(film_options or {})},
            "sampler": {"type": sampler, "sample_count": spp},
        },
        **lights,
        **(shapes or {}),
    }
    if field is not None:
        result["ball"] = ball(field, **(medium or {}))
    return mi.load_dict(result)


def floor(integrator: dict, lights: dict, bsdf: dict, size=16, **shapes):
    """A floor below the object, seen from lower than the object: no camera ray meets the field."""
    to_world = mi.ScalarTransform4f
    return mi.load_dict({
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": to_world().look_at([0.4, -1.9, 2.4], [0.4, -3.5, 1.2], [0, 1, 0]),
            "film": film(size),
            "sampler": {"type": "independent", "sample_count": 16},
        },
        "floor": {
            "type": "rectangle",
            "to_world": to_world().translate([0.4, -3.5, 0.3]).rotate([1, 0, 0], -90).scale(12),
            "bsdf": bsdf,
        },
        **lights,
        **shapes,
    })  # fmt: skip


def render(loaded, seed=0, spp=0) -> np.ndarray:
    """(h, w, 4) linear RGBA."""
    return np.array(mi.render(loaded, seed=seed, spp=spp))
