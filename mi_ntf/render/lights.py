"""Mitsuba's emitters as lights of the field: a table of discrete ones, or Mitsuba's own sampling."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from ..infer.lights import LightTable
from .frame import Frame

DISCRETE = {
    "PointLight": "point",
    "DirectionalEmitter": "directional",
    "EnvironmentMapEmitter": "envmap",
    "ConstantBackgroundEmitter": "constant",
}
"""Mitsuba's class name → plugin name of the emitters that become rows of a table."""
SUBSAMPLES = 4
"""Environment radiance is averaged over SUBSAMPLES² points of each texel of the chosen grid."""


def kinds(scene) -> list[str]:
    """Plugin names of the scene's emitters; the class name of those without a discrete form."""
    return [DISCRETE.get(e.class_name(), e.class_name()) for e in scene.emitters()]


def table(scene, frame: Frame, environment_lights: int) -> LightTable:
    """All emitters as point and directional lights in field coordinates.

    An environment becomes at most `environment_lights` directional lights on a grid of twice as many columns as rows
    (no finer than the map itself), each with the irradiance of its texel, radiance × solid angle, from the direction of
    the texel's centre of radiance. Lights without power are dropped.
    """
    rows = []
    for emitter in scene.emitters():
        kind = DISCRETE.get(emitter.class_name())
        if kind in ("point", "directional"):
            rows.append(_delta(emitter, kind, frame))
        elif kind in ("envmap", "constant"):
            rows.append(_environment(emitter, kind, frame, environment_lights))
        else:
            raise MiNtfError(
                f"emitter {emitter.class_name()} ({emitter.id()}) is no finite set of directions, which an "
                'exhaustive light sum needs; set <integer name="light_samples" value="4"/> on the nrf '
                "integrator with visibility=raymarch or neural_transmittance"
            )
    where, power, is_point = (
        (np.concatenate(c) for c in zip(*rows, strict=True))
        if rows
        else (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    )
    lit = power.max(axis=1, initial=0) > 0
    return LightTable(where[lit], power[lit], is_point[lit], frame.length, mi)


def _delta(emitter, kind: str, frame: Frame):
    """A point or directional light through Mitsuba's own sampling, seen from the sphere's centre."""
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(frame.origin.tolist())
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), True)
    weight = np.array(weight, np.float64).reshape(1, 3)
    if kind == "directional":
        return frame.world_to_field_numpy(_vector(ds.d), direction=True), weight, np.array([False])
    distance = float(np.array(ds.dist).ravel()[0])
    if not distance > 0:
        raise MiNtfError(f"point light ({emitter.id()}) sits exactly at the captured object's centre; move it")
    return frame.world_to_field_numpy(_vector(ds.p)), weight * distance**2, np.array([True])


def _environment(emitter, kind: str, frame: Frame, limit: int):
    """Directional lights of an environment: directions towards them (field), irradiances."""
    rows = max(1, int(np.sqrt(limit / 2)))
    columns = max(1, limit // rows)
    rotation = np.eye(3)
    if kind == "envmap":
        params = mi.traverse(emitter)
        height, width, _ = params["data"].shape
        rows, columns = min(rows, height), min(columns, width - 2)  # two columns are Mitsuba's halo
        rotation = np.array(params["to_world"].matrix, dtype=np.float64)[:3, :3].reshape(3, 3)
        rotation /= np.cbrt(np.linalg.det(rotation))
    n = SUBSAMPLES
    theta = (np.arange(rows * n) + 0.5) * np.pi / (rows * n)
    phi = (np.arange(columns * n) + 0.5) * 2 * np.pi / (columns * n)
    theta, phi = (v.ravel() for v in np.meshgrid(theta, phi, indexing="ij"))
    # Mitsuba's parametrisation of the sphere: y up, u from −z around to +x.
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=1)
    world = local @ rotation.T
    si = dr.zeros(mi.SurfaceInteraction3f, len(world))
    si.wi = mi.Vector3f(*(-world.T).astype(np.float32))
    radiance = np.array(emitter.eval(si), dtype=np.float64).T
    solid_angle = np.sin(theta) * (np.pi / rows / n) * (2 * np.pi / columns / n)
    power = np.broadcast_to(radiance, (len(world), 3)) * solid_angle[:, None]
    weight = power.sum(axis=1) + 1e-12 * solid_angle

    def by_texel(v):
        return v.reshape(rows, n, columns, n, -1).sum(axis=(1, 3)).reshape(rows * columns, -1)

    centre = by_texel(world * weight[:, None])
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    return frame.world_to_field_numpy(centre, direction=True), by_texel(power), np.zeros(rows * columns, bool)


def _vector(v) -> np.ndarray:
    return np.array(v, dtype=np.float64).reshape(1, 3)


class EmitterSamples:
    """`count` samples a shading point by Mitsuba's own emitter sampling: any emitter, unbiased, noisy.

    Same interface as :class:`mi_ntf.infer.lights.LightTable`. `seed`: opaque unsigned integer.
    """

    def __init__(self, scene, frame: Frame, count: int, seed):
        self.scene, self.frame, self.count, self.seed = scene, frame, count, seed

    def sample(self, index, x, active):
        """As LightTable.sample, irradiance = emitter weight/count."""
        lane = dr.arange(mi.UInt32, dr.width(x[0]))
        u = mi.sample_tea_float32(lane, self.seed + 2 * index)
        v = mi.sample_tea_float32(lane, self.seed + 2 * index + 1)
        it = dr.zeros(mi.Interaction3f, dr.width(x[0]))
        it.p = self.frame.point_to_world(x)
        ds, weight = self.scene.sample_emitter_direction(it, mi.Point2f(u, v), False, active)
        weight = dr.select(ds.pdf > 0, weight / self.count, 0)
        return self.frame.direction_to_field(ds.d), tuple(weight), ds.dist / self.frame.length
