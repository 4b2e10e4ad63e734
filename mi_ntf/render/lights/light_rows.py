"""Mitsuba's emitters as rows of a light table.

Point, spot and directional lights are one row each, environments one directional light for each of their cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer.backend import module_of
from ...infer.lights import LightTable
from ..scene.frame import Frame
from . import environment, sun

NO_CONE = (0.0, 0.0, 1.0, 8.0, 9.0)


@dataclass(frozen=True)
class Rows:
    """Lights in scene coordinates, with the arrays of :class:`mi_ntf.infer.lights.LightTable`.

    where     (n, 3) position of a point light, direction towards a directional one
    power     (n, 3) intensity, in units of the scene's length, or irradiance
    is_point  (n,) bool
    cones     (n, 5), or None if no light has a cone
    """

    where: np.ndarray
    power: np.ndarray
    is_point: np.ndarray
    cones: np.ndarray | None = None

    def table(self, frame: Frame) -> LightTable:
        """Return these lights in the field coordinates of `frame`."""
        where = np.where(
            self.is_point[:, None],
            frame.world_to_field_numpy(self.where),
            frame.world_to_field_numpy(self.where, direction=True),
        )
        cones = self.cones
        if cones is not None:
            cones = np.concatenate([frame.world_to_field_numpy(cones[:, :3], direction=True), cones[:, 3:]], axis=1)
        return LightTable(where, self.power, self.is_point, frame.length, module_of(mi.Float), cones)

    def strength(self, places: Sequence[np.ndarray]) -> np.ndarray:
        """Return the irradiance (n,) of each light at the nearest of `places`, without regard to cones."""
        light: np.ndarray = np.abs(self.power).mean(1)
        if not self.is_point.any() or not places:
            return light
        squares = np.stack([((self.where - place) ** 2).sum(1) for place in places]).min(0)
        return np.where(self.is_point, light / np.maximum(squares, 1e-12), light)

    def part(self, selected: np.ndarray) -> Rows:
        """Return the lights with the numbers, or the mask, `selected`."""
        cones = None if self.cones is None else self.cones[selected]
        return Rows(self.where[selected], self.power[selected], self.is_point[selected], cones)


def join(parts: Sequence[Rows], dark: bool = False) -> Rows:
    """Return the rows of all `parts` in order, without those of zero power unless `dark`."""
    if not parts:
        return Rows(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    where, power, is_point = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("where", "power", "is_point")
    )
    lit = (power != 0).any(axis=1) | dark  # negative light counts, as it does for Mitsuba
    cones = None
    if any(p.cones is not None for p in parts):
        cones = np.concatenate([np.tile(NO_CONE, (len(p.power), 1)) if p.cones is None else p.cones for p in parts])
        cones = cones[lit]
    return Rows(where[lit], power[lit], is_point[lit], cones)


def delta(emitter: mi.Emitter, kind: str) -> Rows:
    """Return the row of a ``point``, ``spot`` or ``directional`` light; its power comes from Mitsuba's sampling."""
    if kind == "directional":
        direction, power, _ = _sampled_from(emitter, np.zeros(3))
        return Rows(direction, power, np.array([False]))
    parameters = mi.traverse(emitter)
    if kind == "point":
        position = np.array(parameters["position"], np.float64).ravel()
        axis, cones = np.array([0.0, 0.0, 1.0]), None
    else:
        matrix = np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)
        position, axis = matrix[:3, 3], matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        angles = [np.radians(float(np.ravel(parameters[name])[0])) for name in ("beam_width", "cutoff_angle")]
        cones = np.array([[*axis, *angles]])
    # Sampled from a distance of 1, or from as far as float32 needs to tell the two points apart.
    _, weight, distance = _sampled_from(emitter, position + axis * max(1.0, 1e-3 * np.abs(position).max()))
    return Rows(position[None], weight * distance**2, np.array([True]), cones)


def _sampled_from(emitter: mi.Emitter, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the direction (1, 3) from the scene point `p` to `emitter`, its weight (1, 3) and distance, as sampled."""
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(p.tolist())
    dr.make_opaque(it.p)  # or each place of a light would be compiled into kernels of its own
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5))
    dr.eval(ds.d, ds.dist, weight)
    direction, power = (np.array(v, np.float64).reshape(1, 3) for v in (ds.d, weight))
    return direction, power, float(ds.dist[0])


Lit: TypeAlias = tuple[Rows, environment.Cells | None]
"""Rows of an emitter, and the cells of an environment."""


def sky(emitter: mi.Emitter, kind: str, limit: int) -> Lit:
    """Return at most `limit` directional lights of an ``envmap``, ``constant`` or ``sunsky``, and their cells.

    The sun of a ``sunsky`` is a light of its own and comes last.
    """
    sun_and_sky = sun.sky(emitter) if kind == "sunsky" else None
    limit = max(1, limit - bool(sun_and_sky))
    cells = (environment.cells(sun_and_sky.image, limit) if sun_and_sky
             else environment.cells_of(emitter, kind, limit))
    rotation, _ = environment.placement(emitter, kind)
    where, power = cells.direction @ rotation.T, cells.power
    if sun_and_sky:
        where = np.concatenate([where, sun_and_sky.axis[None]])
        power = np.concatenate([power, sun_and_sky.power[None]])
    return Rows(where, power, np.zeros(len(power), bool)), cells


def _one(emitter: mi.Emitter, kind: str, limit: int) -> Lit:
    return delta(emitter, kind), None


@dataclass(frozen=True)
class Kind:
    """Kind of emitter.

    name    of the plugin
    rows    ``(emitter, name, limit)`` → at most `limit` :class:`Rows`, and the cells of an environment or None; None if
            the emitter is no finite set of lights, so that Mitsuba samples it at random
    single  the emitter is always one row
    """

    name: str
    rows: Callable[[mi.Emitter, str, int], Lit] | None = None
    single: bool = False


KINDS = {
    "PointLight": Kind("point", _one, single=True),
    "SpotLight": Kind("spot", _one, single=True),
    "DirectionalEmitter": Kind("directional", _one, single=True),
    "EnvironmentMapEmitter": Kind("envmap", sky),
    "ConstantBackgroundEmitter": Kind("constant", sky),
    "SunskyEmitter": Kind("sunsky", sky),
    "TimedSunskyEmitter": Kind("timed_sunsky"),
    "AreaLight": Kind("area"),
    "DirectionalArea": Kind("directionalarea"),
    "Projector": Kind("projector"),
}
"""Mitsuba's class name → kind of emitter. Emitters of other classes are sampled at random, by Mitsuba."""


def kind(emitter: mi.Emitter) -> Kind:
    """Return the kind of an emitter; the kind of an ``ntf`` emitter is that of the light that it wraps."""
    inner = getattr(emitter, "inner", None)
    class_name = str(emitter.class_name())
    return kind(inner) if inner is not None else KINDS.get(class_name, Kind(class_name))


@dataclass(frozen=True)
class Discrete:
    """An emitter that is a finite set of lights, with its kind, its rows, and the cells of an environment."""

    emitter: mi.Emitter
    kind: str
    rows: Rows
    cells: environment.Cells | None = None

    @property
    def shining(self) -> int:
        """Number of an environment's cells that have power."""
        return int((self.cells.weight > 0).sum()) if self.cells else 0

    @classmethod
    def of(cls, emitter: mi.Emitter, name: str, environment_lights: int) -> Discrete:
        """Return the lights of an emitter; an environment has at most `environment_lights` rows, dark ones included."""
        rows = kind(emitter).rows
        assert rows is not None  # see is_discrete
        return cls(emitter, name, *rows(emitter, name, environment_lights))
