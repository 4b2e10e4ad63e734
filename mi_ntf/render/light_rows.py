"""Mitsuba's emitters as rows of a light table: point, spot and directional lights as they are, environments as a
directional light per texel."""

import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..infer.lights import LightTable
from .frame import Frame

SUBSAMPLES = 4
"""Environment radiance is averaged over SUBSAMPLES² points of each texel of the chosen grid."""
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


def join(parts: list[Rows], dark: bool = False) -> Rows:
    """All of them, in order, without those that have no power unless `dark`."""
    if not parts:
        return Rows(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    where, power, is_point = (
        np.concatenate([getattr(p, name) for p in parts]) for name in ("where", "power", "is_point")
    )
    lit = (power.max(axis=1, initial=0) > 0) | dark
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
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), True)
    to_host = (np.array(v, np.float64).reshape(1, 3) for v in (ds.d, weight))
    return *to_host, float(np.ravel(ds.dist)[0])


def environment(emitter, kind: str, limit: int, dark: bool = False) -> Rows:
    """At most `limit` directional lights for an ``envmap``, ``constant`` or ``sunsky``; with those without power if
    `dark`.

    On a grid of twice as many columns as rows (no finer than the map itself), each with the irradiance of its texel,
    radiance × solid angle, from the direction of the texel's centre of radiance. The sun is a light of its own.
    """
    parts, sun = [], None
    if kind == "sunsky":
        sun = _Sun(emitter)
        limit = max(1, limit - 1)
        parts.append(sun.rows)
    world, solid_angle, (rows, columns) = texels(emitter, kind, limit)
    n = SUBSAMPLES
    radiance = _radiance(emitter, sun.avoid(world) if sun else world)
    power = radiance * solid_angle[:, None]
    weight = power.sum(axis=1) + 1e-12 * solid_angle

    def by_texel(v):
        return v.reshape(rows, n, columns, n, -1).sum(axis=(1, 3)).reshape(rows * columns, -1)

    centre = by_texel(world * weight[:, None])
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    return join([Rows(centre, by_texel(power), np.zeros(rows * columns, bool)), *parts], dark)


def texels(emitter, kind: str, limit: int):
    """``(world, solid_angle, (rows, columns))``: scene directions and solid angles of SUBSAMPLES² points of each of
    `rows` × `columns` texels, at most `limit`, of an environment; by rows of points."""
    rows = max(1, int(np.sqrt(limit / 2)))
    columns = max(1, limit // rows)
    rotation = _rotation(emitter, kind)
    if kind == "envmap":
        height, width, _ = mi.traverse(emitter)["data"].shape
        rows, columns = min(rows, height), min(columns, width - 2)  # two columns are Mitsuba's halo
    n = SUBSAMPLES
    theta = (np.arange(rows * n) + 0.5) * np.pi / (rows * n)
    phi = (np.arange(columns * n) + 0.5) * 2 * np.pi / (columns * n)
    theta, phi = (v.ravel() for v in np.meshgrid(theta, phi, indexing="ij"))
    # Mitsuba's parametrisation of the sphere: y up, u from −z around to +x.
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=1)
    solid_angle = np.sin(theta) * (np.pi / rows / n) * (2 * np.pi / columns / n)
    return local @ rotation.T, solid_angle, (rows, columns)


def _rotation(emitter, kind: str) -> np.ndarray:
    """Columns: the environment's x, y and z axes in the scene, y being up (``sunsky`` has z up)."""
    if kind == "constant":
        return np.eye(3)
    rotation = np.array(mi.traverse(emitter)["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    rotation = rotation / np.linalg.norm(rotation, axis=0)
    return rotation[:, [1, 2, 0]] if kind == "sunsky" else rotation


def _radiance(emitter, towards: np.ndarray) -> np.ndarray:
    """(n, 3) radiance that arrives from the scene directions `towards` (n, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(towards))
    si.wi = mi.Vector3f(*(-towards.T).astype(np.float32))
    radiance = np.array(emitter.eval(si), dtype=np.float64).reshape(3, -1).T
    return np.broadcast_to(radiance, (len(towards), 3))


class _Sun:
    """The sun's disc of a ``sunsky``: `rows`, one directional light of its irradiance above the sky's."""

    def __init__(self, emitter, rings: int = 16):
        self.axis = np.array(mi.traverse(emitter)["sun_direction"], np.float64).ravel()
        # The aperture is no scene parameter; the plugin prints it, in degrees.
        printed = re.search(r"Sun aperture = ([\d.e+-]+)", str(emitter))
        self.half_aperture = np.radians(float(printed[1]) / 2) if printed else 0.0
        side = np.cross(self.axis, [0.0, 0.0, 1.0] if abs(self.axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        self._side = side / np.linalg.norm(side)
        self._up = np.cross(self._side, self.axis)
        cap = 1 - np.cos(self.half_aperture)
        cos = 1 - (np.arange(rings) + 0.5) / rings * cap  # rings of equal solid angle
        phi = (np.arange(4 * rings) + 0.5) * np.pi / (2 * rings)
        cos, phi = (v.ravel() for v in np.meshgrid(cos, phi))
        disc = self._around(np.arccos(cos), phi)
        glow = _radiance(emitter, disc) - _radiance(emitter, self.avoid(disc))
        power = np.maximum(glow, 0).mean(axis=0, keepdims=True) * 2 * np.pi * cap
        self.rows = Rows(self.axis[None], power, np.array([False]))

    def _around(self, angle, phi) -> np.ndarray:
        across = np.cos(phi)[:, None] * self._side + np.sin(phi)[:, None] * self._up
        return np.cos(angle)[..., None] * self.axis + np.sin(angle)[..., None] * across

    def avoid(self, towards: np.ndarray) -> np.ndarray:
        """`towards` (n, 3) with those on the disc moved to just beside it, where the sky is the same."""
        on = towards @ self.axis > np.cos(self.half_aperture * 1.01)
        phi = np.arctan2(towards @ self._up, towards @ self._side)
        beside = self._around(np.full(len(towards), self.half_aperture * 1.02), phi)
        return np.where(on[:, None], beside, towards)
