"""The lights of table 2: point lights around the object, and 18 environments, each a name and an emitter.

All of it is made from what is shipped, the same in every run. Brightness is of one kind everywhere, since SSIM and rMSE
know no exposure: a white surface that faces the point light shines 1, and every environment has the mean radiance of
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

from .compared import SCENES

DISTANCE = 3.2
"""Of lights and moving cameras from the object's centre, in radii of its sphere, as photographs are taken."""
BEHIND = 1.02
"""The light of a moving camera is so much farther away than the camera. The paper moves the camera `on the same
position as light`; exactly there the renderer knows that no shadow is seen, whatever the method."""
ENVIRONMENT = SCENES / "common" / "env.exr"
TURNS = 6
"""Rotations of the shipped environment about the vertical; the other environments are skies."""
ELEVATIONS, AZIMUTHS = (15, 40, 65), (20, 110, 200, 290)
"""Degrees of the skies' suns."""
TURBIDITY, GROUND = 4.0, 0.2
"""Of the skies; radiance of what is below the horizon, as a share of the sky's mean."""


@dataclass(frozen=True)
class Light:
    """One picture's light. `name`: of files; `title`: for readers; `emitter`: Mitsuba dict; `camera`: its place where
    the camera moves, scene units, None: the scene's own camera; `shown`: whether the report shows its pictures;
    `about`: what tells it from others, JSON."""

    name: str
    title: str
    kind: str
    emitter: dict[str, Any]
    camera: tuple[float, float, float] | None = None
    shown: bool = False
    about: Any = None


def point_lights(count: int, centre: Sequence[float], radius: float, camera: np.ndarray) -> list[Light]:
    """`count` point lights at DISTANCE around a sphere (scene units): first those that move alone, then, from half of
    them on, those that the camera moves with. Shown: the one of the first half that is nearest to the upper right of
    the scene's `camera` (3,)."""
    found = []
    still = count - count // 2
    towards = np.asarray(camera, float) - centre
    wanted = towards + np.linalg.norm(towards) * (np.array([0, 0.6, 0]) + 0.4 * _right(towards))
    first = spheres.fibonacci(still)
    shown = int(np.argmax(first @ wanted))
    for k, d in enumerate([*first, *spheres.fibonacci(count // 2, 0.5)]):
        moving = k >= still
        distance = radius * DISTANCE
        away = distance * (BEHIND if moving else 1)
        place = [float(v) for v in np.asarray(centre) + away * d]
        x, y, z = (float(v) for v in np.asarray(centre) + distance * d)
        eye = (x, y, z) if moving else None
        emitter = {"type": "point", "position": place, "intensity": float(np.pi * away**2)}
        title = f"point light {k + 1}" + (", the camera beside it" if moving else "")
        found.append(Light(f"point-{k:03}", title, "point", emitter, eye, k == shown, [place, eye]))
    return found


def _right(towards: np.ndarray) -> np.ndarray:
    right = np.cross([0, 1, 0], towards)
    return right / max(np.linalg.norm(right), 1e-9)


def environments(count: int, folder: Path | None = None) -> list[Light]:
    """The first `count` environments, kinds in turn; those of `folder` (.hdr, .exr), sorted by name, if it is given:
    all of them where `count` is 0."""
    maps = _shipped() if folder is None else _given(Path(folder))
    wanted = mean_radiance(read(ENVIRONMENT))
    found = []
    for k, (name, image) in enumerate(maps[:count or None]):
        mean = mean_radiance(image)
        if mean <= 0:
            raise MiNtfError(f"environment {name} is black; remove it from the folder, or give it light")
        scaled = np.ascontiguousarray(image * (wanted / mean), np.float32)
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(scaled)}
        about = [list(scaled.shape), hashlib.sha256(scaled.tobytes()).hexdigest()]
        found.append(Light(f"environment-{k:03}", name, "environment", emitter, None, k == 0, about))
    return found


def read(path: Path) -> np.ndarray:
    """Radiance (h, w, 3) of a latitude-longitude map. Raises MiNtfError."""
    try:
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise MiNtfError(f"environment {path} cannot be read ({error}); give .hdr or .exr") from None
    image = np.array(bitmap)
    if not np.isfinite(image).all() or image.min() < 0:
        raise MiNtfError(f"environment {path} has negative, infinite or undefined pixels; give radiance from 0 on")
    return image


def mean_radiance(image: np.ndarray) -> float:
    """Mean over the sphere of a latitude-longitude map (h, w, 3), and over channels."""
    weight = np.sin((np.arange(len(image)) + 0.5) / len(image) * np.pi)
    return float(np.average(image.mean((1, 2)), weights=weight))


def _shipped() -> list[tuple[str, np.ndarray]]:
    """Six turns of the shipped map and twelve skies, a turn after every two skies, so that a few are of both kinds."""
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
    """Mitsuba's ``sunsky`` with its sun at these degrees as a latitude-longitude map (h, w, 3), means of `finer`²
    samples a pixel, and an even ground."""
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


def _given(folder: Path) -> list[tuple[str, np.ndarray]]:
    if not folder.is_dir():
        raise MiNtfError(f"--environments {folder} is no folder; give one with .hdr or .exr maps")
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".hdr", ".exr"))
    if not paths:
        raise MiNtfError(f"--environments {folder} holds no .hdr or .exr file; put latitude-longitude maps there")
    return [(path.name, read(path)) for path in paths]
