"""Mitsuba's emitters as rows of a light table: point, spot and directional lights as they are, environments as a
directional light for each of their cells."""

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer.lights import LightTable
from ..scene.frame import Frame
from . import environment, sun

NO_CONE = (0.0, 0.0, 1.0, 8.0, 9.0)


@dataclass(frozen=True)
class Rows:
    """Lights in scene coordinates: `where`, `power`, `is_point`, `cones` of :class:`mi_ntf.infer.lights.LightTable`,
    power per square of a scene unit; `cones` is None where no light has one."""

    where: np.ndarray
    power: np.ndarray
    is_point: np.ndarray
    cones: np.ndarray | None = None

    def table(self, frame: Frame) -> LightTable:
        """These lights in the field coordinates of `frame`."""
        where = np.where(
            self.is_point[:, None],
            frame.world_to_field_numpy(self.where),
            frame.world_to_field_numpy(self.where, direction=True),
        )
        cones = self.cones
        if cones is not None:
            cones = np.concatenate([frame.world_to_field_numpy(cones[:, :3], direction=True), cones[:, 3:]], axis=1)
        return LightTable(where, self.power, self.is_point, frame.length, mi, cones)

    def strength(self, places: list) -> np.ndarray:
        """(n,) irradiance of each light where it is strongest of all `places`, cones left aside."""
        light = np.abs(self.power).mean(1)
        if not self.is_point.any() or not places:
            return light
        squares = np.stack([((self.where - place) ** 2).sum(1) for place in places]).min(0)
        return np.where(self.is_point, light / np.maximum(squares, 1e-12), light)

    def part(self, kept: np.ndarray) -> "Rows":
        """Return the lights for which the mask `kept` (n,) is True."""
        cones = None if self.cones is None else self.cones[kept]
        return Rows(self.where[kept], self.power[kept], self.is_point[kept], cones)


def join(parts: list[Rows], dark: bool = False) -> Rows:
    """Return the rows of all `parts` in order, without those of zero power unless `dark`."""
    if not parts:
        return Rows(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    where, power, is_point = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("where", "power", "is_point")
    )
    # What is negative counts, as it does for Mitsuba.
    lit = (power != 0).any(axis=1) | dark
    cones = None
    if any(p.cones is not None for p in parts):
        cones = np.concatenate([np.tile(NO_CONE, (len(p.power), 1)) if p.cones is None else p.cones for p in parts])
        cones = cones[lit]
    return Rows(where[lit], power[lit], is_point[lit], cones)


def delta(emitter, kind: str) -> Rows:
    """A ``point``, ``spot`` or ``directional`` light. Its power comes from Mitsuba's own sampling."""
    if kind == "directional":
        direction, power, _ = _look(emitter, np.zeros(3))
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
    # From one unit off, or as far as float32 needs to tell the two points apart.
    _, weight, distance = _look(emitter, position + axis * max(1.0, 1e-3 * np.abs(position).max()))
    return Rows(position[None], weight * distance**2, np.array([True]), cones)


def _look(emitter, p: np.ndarray):
    """Direction towards `emitter` (1, 3), its weight (1, 3) and distance, sampled at the scene point `p`."""
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(p.tolist())
    dr.make_opaque(it.p)  # or every place of a light would be compiled into kernels of its own
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), True)
    dr.eval(ds.d, ds.dist, weight)
    to_host = (np.array(v, np.float64).reshape(1, 3) for v in (ds.d, weight))
    return *to_host, float(np.ravel(ds.dist)[0])


def sky(emitter, kind: str, limit: int) -> tuple[Rows, environment.Cells]:
    """At most `limit` directional lights for an ``envmap``, ``constant`` or ``sunsky``, and the cells that they are of;
    the sun of a ``sunsky`` comes last, a light of its own."""
    found = sun.sky(emitter) if kind == "sunsky" else None
    limit = max(1, limit - bool(found))
    cells = environment.cells(found.image, limit) if found else environment.cells_of(emitter, kind, limit)
    rotation, _ = environment.placement(emitter, kind)
    where, power = cells.direction @ rotation.T, cells.power
    if found:
        where, power = np.concatenate([where, found.axis[None]]), np.concatenate([power, found.power[None]])
    return Rows(where, power, np.zeros(len(power), bool)), cells


@dataclass(frozen=True)
class Kind:
    """A kind of emitter. `name`: the plugin's; `rows`: ``(emitter, name, limit)`` → :class:`Rows`, at most `limit` of
    them, and the cells of an environment or None; it is None itself for what is no finite set of lights and is drawn at
    random. `single`: it is always one row."""

    name: str
    rows: Callable | None = None
    single: bool = False


def _one(emitter, name: str, limit: int):
    return delta(emitter, name), None


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
"""Mitsuba's class name → what is known of it. Others are drawn at random, by Mitsuba's own sampling."""


def kind(emitter) -> Kind:
    """The kind of an emitter, of ``ntf`` that of what it wraps."""
    inner = getattr(emitter, "inner", None)
    return kind(inner) if inner is not None else KINDS.get(emitter.class_name(), Kind(emitter.class_name()))
