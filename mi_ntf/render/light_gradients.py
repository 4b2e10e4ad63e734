"""Derivatives of a light table by the parameters of Mitsuba's emitters: intensity, irradiance, radiance, an
environment's texels, position and direction."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from . import light_rows
from .frame import Frame

MAX_MOVING = 32
"""Lights of a table whose positions are attached: each is a kernel of its own."""


def attach(table, rows: light_rows.Rows, emitters: list, limit: int, frame: Frame) -> None:
    """Give the light table of `rows` the gradients of the discrete `emitters`, pairs of emitter and kind, if they have
    any. `limit`: most lights of an environment; `frame`: whose coordinates the table is in.

    Environments are attached by the power of their texels alone. Their directions, a ``sunsky`` and the cones of spots
    stay as they are; lights without power, which the table leaves out, have no gradients.
    """
    if not any(dr.grad_enabled(value) for emitter, _ in emitters for _, value in mi.traverse(emitter)):
        return
    parts = [_environment(e, k, limit) if k in ("envmap", "constant", "sunsky") else _single(e, k) for e, k in emitters]
    where, power = ([dr.ravel(part[i]) for part in parts] for i in (0, 1))
    where, power = (_join(arrays) for arrays in (where, power))
    lit = mi.UInt32(np.flatnonzero(np.array(dr.detach(power)).reshape(-1, 3).max(axis=1) > 0))
    where, power = dr.gather(mi.Point3f, where, lit), dr.gather(mi.Color3f, power, lit)
    point, direction = frame.point_to_field(where), frame.direction_to_field(where)
    is_point = mi.Bool(rows.is_point)
    table.attach(tuple(dr.select(is_point, p, d) for p, d in zip(point, direction, strict=True)), tuple(power))
    if table.moving and table.count > MAX_MOVING:
        raise MiNtfError(
            f"gradients by the place of a light: the scene has {table.count} lights, expected {MAX_MOVING} at most; "
            "lower environment_lights or detach position and to_world"
        )


def _single(emitter, kind: str):
    """Place (or direction) and power of a point, spot or directional light, from Mitsuba's own sampling."""
    row = light_rows.delta(emitter, kind)
    axis = np.array([0.0, 0.0, 1.0]) if row.cones is None else row.cones[0, :3]
    it = dr.zeros(mi.Interaction3f)
    if kind != "directional":
        it.p = mi.Point3f((row.where[0] + axis * max(1.0, 1e-3 * np.abs(row.where).max())).tolist())
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5), True)
    if kind == "directional":
        return mi.Point3f(ds.d), weight
    return ds.p, weight * dr.squared_norm(ds.p - it.p)


def _environment(emitter, kind: str, limit: int):
    """As :func:`_single` for all texels; the places are fixed."""
    fixed = light_rows.environment(emitter, kind, limit, dark=True)
    where = mi.Point3f(*fixed.where.T.astype(np.float32))
    if kind == "sunsky":
        return where, mi.Color3f(*fixed.power.T.astype(np.float32))
    world, solid_angle, (rows, columns) = light_rows.texels(emitter, kind, limit)
    si = dr.zeros(mi.SurfaceInteraction3f, len(world))
    si.wi = mi.Vector3f(*(-world.T).astype(np.float32))
    radiance = emitter.eval(si) * mi.Float(solid_angle.astype(np.float32))
    n = light_rows.SUBSAMPLES
    row, column = np.divmod(np.arange(len(world)), columns * n)
    texel = mi.UInt32((row // n * columns + column // n).astype(np.uint32))
    power = [dr.zeros(mi.Float, rows * columns) for _ in range(3)]
    for total, channel in zip(power, radiance, strict=True):
        dr.scatter_add(total, channel, texel)
    return where, mi.Color3f(*power)


def _join(arrays: list):
    """Arrays one after the other."""
    total = dr.zeros(mi.Float, sum(dr.width(a) for a in arrays))
    first = 0
    for a in arrays:
        dr.scatter(total, a, dr.arange(mi.UInt32, dr.width(a)) + first)
        first += dr.width(a)
    return total
