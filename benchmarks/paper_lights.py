"""The lights of the paper's table 2 on our scenes: point lights around the object, and 18 environments.

They are made from shipped files and are the same in every run. Their brightness is uniform, since SSIM and rMSE depend
on the exposure: a white surface that faces a point light has radiance 1, and every environment has the mean radiance of
the shipped one.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ntf.core import spheres
from mi_ntf.core.errors import MiNtfError

from .scenes import SCENES

DISTANCE = 3.2
"""Distance of lights and moving cameras from the object's centre, in radii of its sphere."""
BEHIND = 1.02
"""Distance of a light from the object over that of the camera that moves with it.

The paper moves the camera to the position of the light. Exactly there the renderer needs no method, since every visible
point is lit.
"""
ENVIRONMENT = SCENES / "common" / "env.exr"
TURNS = 6
"""Rotations of the shipped environment about the vertical; the other environments are skies."""
ELEVATIONS, AZIMUTHS = (15, 40, 65), (20, 110, 200, 290)
"""Directions of the skies' suns in degrees."""
TURBIDITY, GROUND = 4.0, 0.2
"""Turbidity of the skies, and radiance below the horizon over the mean radiance of the sky."""


@dataclass(frozen=True)
class Light:
    """The light of one picture.

    - name: for files
    - title: for readers
    - kind: ``point`` or ``environment``
    - emitter: Mitsuba dict
    - camera: place of a camera that moves, in scene units; None for the scene's own camera
    - about: values that tell the light from others, for JSON
    """

    name: str
    title: str
    kind: str
    emitter: dict[str, Any]
    camera: tuple[float, float, float] | None = None
    about: Any = None


def point_lights(count: int, centre: Sequence[float], radius: float) -> list[Light]:
    """Return point lights around a sphere in scene units.

    The first half moves alone, with the others the camera moves.
    """
    lights = []
    still = count - count // 2
    for k, d in enumerate([*spheres.fibonacci(still), *spheres.fibonacci(count // 2, 0.5)]):
        moving = k >= still
        distance = radius * DISTANCE
        far = distance * (BEHIND if moving else 1)
        place = [float(v) for v in np.asarray(centre) + far * d]
        x, y, z = (float(v) for v in np.asarray(centre) + distance * d)
        eye = (x, y, z) if moving else None
        emitter = {"type": "point", "position": place, "intensity": float(np.pi * far**2)}
        title = f"point light {k + 1}" + (", the camera beside it" if moving else "")
        lights.append(Light(f"point-{k:03}", title, "point", emitter, eye, [place, eye]))
    return lights


def environments(count: int, folder: Path | None = None) -> list[Light]:
    """Return the first `count` environments, or all of them where it is 0.

    They are those of `folder` (.hdr, .exr) in the order of their names, or made from the shipped one.
    """
    maps = _shipped() if folder is None else _read_all(Path(folder))
    radiance = mean_radiance(read(ENVIRONMENT))
    lights = []
    for k, (name, image) in enumerate(maps[:count or None]):
        mean = mean_radiance(image)
        if mean <= 0:
            raise MiNtfError(f"environment {name} is black; remove it from the folder, or give it light")
        scaled = np.ascontiguousarray(image * (radiance / mean), np.float32)
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(scaled)}
        about = [list(scaled.shape), hashlib.sha256(scaled.tobytes()).hexdigest()]
        lights.append(Light(f"environment-{k:03}", name, "environment", emitter, None, about))
    return lights


def read(path: Path) -> np.ndarray:
    """Return the radiance (h, w, 3) of a latitude-longitude map. Raises MiNtfError."""
    try:
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise MiNtfError(f"environment {path} cannot be read ({error}); give .hdr or .exr") from None
    image = np.array(bitmap)
    if not np.isfinite(image).all() or image.min() < 0:
        raise MiNtfError(f"environment {path} has negative, infinite or undefined pixels; give radiance from 0 on")
    return image


def mean_radiance(image: np.ndarray) -> float:
    """Return the mean over the sphere and over channels of a latitude-longitude map (h, w, 3)."""
    weight = np.sin((np.arange(len(image)) + 0.5) / len(image) * np.pi)
    return float(np.average(image.mean((1, 2)), weights=weight))


def _shipped() -> list[tuple[str, np.ndarray]]:
    """Return six turns of the shipped map and twelve skies, two skies after each turn."""
    if not ENVIRONMENT.is_file():
        raise MiNtfError(f"{ENVIRONMENT} does not exist; run in a checkout, or give --environments FOLDER")
    image = read(ENVIRONMENT)
    width = image.shape[1]
    turns = []
    for k in range(TURNS):
        columns = round(width * k / TURNS)
        turns.append((f"env.exr turned by {360 * columns / width:.0f}°", np.roll(image, columns, 1)))
    suns = [(e, a) for a in AZIMUTHS for e in ELEVATIONS]
    skies = [(f"sky, sun {e}° high at {a}°", sky(e, a)) for e, a in suns]
    return [m for k, turn in enumerate(turns) for m in (turn, *skies[2 * k:2 * k + 2])]


def sky(elevation: float, azimuth: float, width: int = 64, height: int = 32, finer: int = 16) -> np.ndarray:
    """Return Mitsuba's ``sunsky`` as a latitude-longitude map (h, w, 3), with a uniform ground.

    Elevation and azimuth of the sun are in degrees. A pixel is the mean of `finer`² samples.
    """
    e, a = np.radians((elevation, azimuth))
    sun = [float(np.cos(e) * np.sin(a)), float(np.cos(e) * np.cos(a)), float(np.sin(e))]  # its own axes have z up
    emitter = mi.load_dict({"type": "sunsky", "sun_direction": sun, "turbidity": TURBIDITY, "sun_aperture": 2.0})
    u, v = np.meshgrid((np.arange(width * finer) + 0.5) / (width * finer) * 2 * np.pi,
                       (np.arange(height * finer) + 0.5) / (height * finer) * np.pi)
    # Directions of Mitsuba's envmap, y up, turned into the sky's.
    x, y, z = np.sin(u) * np.sin(v), np.cos(v), -np.cos(u) * np.sin(v)
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(*(mi.Float(c.ravel().astype(np.float32)) for c in (x, -z, y)))
    values = np.array(emitter.eval(si)).T.reshape(height, finer, width, finer, 3).mean((1, 3))
    upper = values[:height // 2]
    values[height // 2:] = GROUND * upper.mean((0, 1))
    return np.maximum(values, 0).astype(np.float32)


def _read_all(folder: Path) -> list[tuple[str, np.ndarray]]:
    if not folder.is_dir():
        raise MiNtfError(f"--environments {folder} is no folder; give one with .hdr or .exr maps")
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".hdr", ".exr"))
    if not paths:
        raise MiNtfError(f"--environments {folder} holds no .hdr or .exr file; put latitude-longitude maps there")
    return [(path.name, read(path)) for path in paths]
