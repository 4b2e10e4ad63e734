"""Transmittance along one ray that meets the object: marched, and as networks answer after more and more training; and
what random rays are worth to a network."""

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf import swap
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.maps import building

from .. import bench_paper, transmittance
from ..loops import table_of
from ..photographs import field_ball
from . import images
from .compared import Scene, Sizes

POINTS = 400
"""Along the ray."""
SIDE = 33
"""Camera rays along a side of the picture, among which the ray is chosen."""
FINE = 2 / 1536
"""Step of the march."""
DARK = 0.01


def along(scene: Scene, methods: dict[str, tuple[Path, str]]) -> dict:
    """Row of the job: ``t``, places on the ray, field units, towards the light, and ``curves``, τ at them: ``marched``
    through the shipped field, and those of `methods`, title → ``(field file, visibility)``.

    The ray is the camera's, backwards, as of a light at the camera; the first from the middle of the picture on that
    is dark at its end. Raises MiNtfError where the object covers none.
    """
    m, d, h = _ray(scene)
    t = np.linspace(-h, h, POINTS)
    x = tuple(mi.Float((m[k] + t * d[k]).astype(np.float32)) for k in range(3))
    curves = {"marched": _tau(scene.field, "raymarch", x, d)}
    for title, (field, visibility) in methods.items():
        curves[title] = _tau(field, visibility, x, d)
    return {"t": t.round(5).tolist(), "curves": {k: v.round(5).tolist() for k, v in curves.items()}}


def _ray(scene: Scene) -> tuple[np.ndarray, np.ndarray, float]:
    """``(m, d, h)``: middle of the chord, direction towards the light, half its length."""
    sensor = images.meshes(scene, 16).sensors()[0]
    medium = _medium(scene.field)
    o, away, _ = bench_paper.view_rays(sensor, medium.frame, SIDE)
    o, away = (np.array(v).T.astype(np.float64) for v in (o, away))
    middle = SIDE // 2
    order = np.argsort(np.hypot(np.arange(SIDE**2) % SIDE - middle, np.arange(SIDE**2) // SIDE - middle))
    start, way = (tuple(mi.Float(c) for c in v[order].T.astype(np.float32)) for v in (o, away))
    through = _from(medium, "raymarch", start, way, np.array([[0.0, 0.0, 1.0]]))
    dark = np.flatnonzero(through < DARK)
    if not len(dark):
        raise MiNtfError(f"scene {scene.name}: no camera ray ends on the object, so no curve can be drawn; turn its "
                         "sensor towards the object")
    first, d = o[order[dark[0]]], -away[order[dark[0]]]
    m = first - (first @ d) * d
    return m, d, float(np.sqrt(1 - m @ m))


def _tau(field: Path, visibility: str, x, d: np.ndarray) -> np.ndarray:
    """τ from the points `x` towards a light along `d`."""
    return _from(_medium(field), visibility, x, tuple(mi.Float(float(c)) for c in d), d[None])


def _from(medium, visibility: str, x, wi, lights: np.ndarray) -> np.ndarray:
    """τ of a `medium` from `x` along `wi`, without an end; `lights`: what maps are made for."""
    built = building.build(visibility, medium, table_of(lights), building.Options(FINE))
    width = dr.width(x)
    infinite, active = dr.full(mi.Float, dr.inf, width), dr.full(mi.Bool, True, width)
    return np.array(built.tau(x, wi, infinite, dr.zeros(mi.UInt32, width), active), np.float64)


def _medium(field: Path):
    ball: Any = mi.load_dict(field_ball(field))
    return ball.interior_medium()


def ablation(scene: Scene, field: Path, folder: Path, sizes: Sizes) -> dict:
    """Row of the job: relative RMSE under directional lights against ``raymarch`` on the same field, by
    :func:`benchmarks.transmittance.study`, of the network in `field`."""
    path = folder / f"{field.stem}.xml"
    swap.swap(scene.mesh, field, path)
    found = transmittance.study(path, *sizes.study)
    return {"relative_rmse": {k: found[k] for k in ("ray_network", "map, network, 128²")}, "ns": found["ns"]}
