"""Derivatives of a light table by the parameters of Mitsuba's emitters: intensity, irradiance, radiance, an
environment's texels, position and direction. :mod:`mi_ntf.render.scene.gradient_checks` refuses all others."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ..scene.frame import Frame
from . import environment, light_rows

MAX_MOVING = 32
"""Lights of a table whose positions are attached: each is a kernel of its own."""


def attached(emitters: list) -> bool:
    """Whether a parameter of one of `emitters` carries gradients."""
    return any(dr.grad_enabled(value) for emitter in emitters for _, value in mi.traverse(emitter))


def attach(table, rows: light_rows.Rows, discrete: list, frame: Frame) -> None:
    """Give the light table of `rows` the gradients of `discrete` (:class:`mi_ntf.render.lights.scene_lights.Discrete`),
    if they have any; `rows` are then all of theirs, dark ones included. `frame`: whose coordinates the table is in.

    Environments are attached by the power of their cells, every texel of them, dark or bright; each shines from its
    cell's centre. Cells and directions stay as they are, and so does a ``sunsky``.
    """
    if not attached([d.emitter for d in discrete]):
        return
    parts = [_environment(d) if d.cells else _single(d.emitter, d.kind) for d in discrete]
    where, power = (_join([dr.ravel(part[i]) for part in parts]) for i in (0, 1))
    where, power = dr.unravel(mi.Point3f, where), dr.unravel(mi.Color3f, power)
    axes = _axes(rows, discrete, frame) if rows.cones is not None else None
    point, direction = frame.point_to_field(where), frame.direction_to_field(where)
    is_point = mi.Bool(rows.is_point)
    table.attach(tuple(dr.select(is_point, p, d) for p, d in zip(point, direction, strict=True)), tuple(power), axes)
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


def _axes(rows, discrete: list, frame: Frame):
    """Unit 3-tuple away from each spot light, in the coordinates of `frame`."""
    axes = mi.Vector3f(*rows.cones[:, :3].T.astype(np.float32))
    first = 0
    for light in discrete:
        if light.kind == "spot":
            along = dr.normalize(mi.traverse(light.emitter)["to_world"] @ mi.Vector3f(0, 0, 1))
            dr.scatter(axes, along, mi.UInt32(first))
        first += len(light.rows.power)
    return frame.direction_to_field(axes)


def _environment(light):
    """As :func:`_single` for all cells; the places are fixed."""
    where = mi.Point3f(*light.rows.where.T.astype(np.float32))
    if light.kind == "sunsky":
        return where, mi.Color3f(*light.rows.power.T.astype(np.float32))
    if light.kind == "constant":
        si = dr.zeros(mi.SurfaceInteraction3f)
        return where, light.emitter.eval(si) * mi.Float(light.cells.solid_angle.astype(np.float32))
    parameters = mi.traverse(light.emitter)
    data, scale = parameters["data"], parameters["scale"]
    return where, environment.power(data.array * scale, data.shape[:2], light.cells)


def _join(arrays: list):
    """Arrays one after the other."""
    total = dr.zeros(mi.Float, sum(dr.width(a) for a in arrays))
    first = 0
    for a in arrays:
        dr.scatter(total, a, dr.arange(mi.UInt32, dr.width(a)) + first)
        first += dr.width(a)
    return total
