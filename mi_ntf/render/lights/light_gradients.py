"""Derivatives of a light table by the parameters of Mitsuba's emitters.

These are intensity, irradiance, radiance, an environment's texels, position and direction. All others are refused by
:mod:`mi_ntf.render.transport.effects`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer.lights import LightTable
from ...infer.types import Color3, Float, UInt32, Vector, Vector3
from ..scene.frame import Frame
from . import environment, light_rows
from .light_rows import Discrete

MAX_MOVING = 32
"""Largest number of lights in a table whose positions are attached, since each takes a kernel of its own."""


def attached(emitters: Sequence[mi.Emitter]) -> bool:
    """Return True if a parameter of one of `emitters` carries gradients."""
    return any(dr.grad_enabled(value) for emitter in emitters for _, value in mi.traverse(emitter))


def attach(table: LightTable, rows: light_rows.Rows, discrete: Sequence[Discrete], frame: Frame) -> None:
    """Attach the gradients of the emitters `discrete`, if they carry any, to their light table.

    `rows` are then all of their rows, dark ones included; the table has the field coordinates of `frame`. Environments
    are attached by the power of their cells, which follows from each texel, dark or bright. Cells, their directions
    and a ``sunsky`` stay as they are.
    """
    if not attached([d.emitter for d in discrete]):
        return
    parts = [_environment(d, d.cells) if d.cells else _single(d.emitter, d.kind) for d in discrete]
    where, power = (_join([dr.ravel(part[i]) for part in parts]) for i in (0, 1))
    where, power = dr.unravel(mi.Point3f, where), dr.unravel(mi.Color3f, power)
    axes = None if rows.cones is None else _axes(rows.cones, discrete, frame)
    point, direction = frame.point_to_field(where), frame.direction_to_field(where)
    is_point = mi.Bool(rows.is_point)
    table.attach(tuple(dr.select(is_point, p, d) for p, d in zip(point, direction, strict=True)), tuple(power), axes)
    if table.moving and table.count > MAX_MOVING:
        raise MiNtfError(
            f"gradients by the place of a light: the scene has {table.count} lights, expected {MAX_MOVING} at most; "
            "lower environment_lights or detach position and to_world"
        )


def _single(emitter: mi.Emitter, kind: str) -> tuple[Vector3, Color3]:
    """Return place (or direction) and power of a point, spot or directional light, from Mitsuba's own sampling."""
    row = light_rows.delta(emitter, kind)
    axis = np.array([0.0, 0.0, 1.0]) if row.cones is None else row.cones[0, :3]
    it = dr.zeros(mi.Interaction3f)
    if kind != "directional":
        it.p = mi.Point3f((row.where[0] + axis * max(1.0, 1e-3 * np.abs(row.where).max())).tolist())
    ds, weight = emitter.sample_direction(it, mi.Point2f(0.5))
    if kind == "directional":
        return mi.Point3f(ds.d), weight
    return ds.p, weight * dr.squared_norm(ds.p - it.p)


def _axes(cones: np.ndarray, discrete: Sequence[Discrete], frame: Frame) -> Vector:
    """Return unit vectors away from the spot lights, in the coordinates of `frame`."""
    axes = mi.Vector3f(*cones[:, :3].T.astype(np.float32))
    first = 0
    for light in discrete:
        if light.kind == "spot":
            along = dr.normalize(mi.traverse(light.emitter)["to_world"] @ mi.Vector3f(0, 0, 1))
            dr.scatter(axes, along, mi.UInt32(first))
        first += len(light.rows.power)
    return frame.direction_to_field(axes)


def _environment(light: Discrete, cells: environment.Cells) -> tuple[Vector3, Color3]:
    """Return the directions of all `cells`, which are fixed, and their power."""
    where = mi.Point3f(*light.rows.where.T.astype(np.float32))
    if light.kind == "sunsky":
        return where, mi.Color3f(*light.rows.power.T.astype(np.float32))
    if light.kind == "constant":
        radiance: Color3 = light.emitter.eval(dr.zeros(mi.SurfaceInteraction3f))
        return where, radiance * mi.Float(cells.solid_angle.astype(np.float32))
    parameters = mi.traverse(light.emitter)
    data, scale = parameters["data"], parameters["scale"]
    return where, cell_power(data.array * scale, data.shape[:2], cells)


def cell_power(texels: Float, shape: tuple[int, int], cells: environment.Cells) -> Color3:
    """Return the power of `cells` as a Color3f that carries the gradients of `texels`.

    `texels`: numbers of a map of `shape` lines and columns, which include the repeated column on either side.
    """
    latitude, longitude = cells.axes
    owner = np.zeros((len(latitude.first), len(longitude.first)), np.uint32)
    for i, (r0, r1, c0, c1) in enumerate(cells.bounds):
        owner[r0:r1, c0:c1] = i
    # Each pair of pieces is one lane. Its four texels times their weights belong to one cell.
    column, row = dr.meshgrid(*(dr.arange(mi.UInt32, len(axis.texel)) for axis in (longitude, latitude)))

    def entry(numbers: np.ndarray, index: UInt32) -> UInt32:
        return dr.gather(mi.UInt32, mi.UInt32(numbers.astype(np.uint32)), index)

    def weight(axis: environment.Axis, side: int, index: UInt32) -> Float:
        return dr.gather(mi.Float, mi.Float(axis.weights[:, side, 0].astype(np.float32)), index)

    cell = entry(owner.ravel(), entry(latitude.block * owner.shape[1], row) + entry(longitude.block, column))
    corners = []
    for down, right in itertools.product((0, 1), repeat=2):
        texel = entry((latitude.texel + down) * shape[1], row)
        texel += entry((longitude.texel + right) % (shape[1] - 2) + 1, column)
        corners.append((weight(latitude, down, row) * weight(longitude, right, column), texel))
    total = [dr.zeros(mi.Float, len(cells.bounds)) for _ in range(3)]
    for i, channel in enumerate(total):
        value = sum(factor * dr.gather(mi.Float, texels, 3 * texel + i) for factor, texel in corners)
        dr.scatter_add(channel, value, cell)
    return mi.Color3f(*total)


def _join(arrays: Sequence[Float]) -> Float:
    """Concatenate arrays."""
    total = dr.zeros(mi.Float, sum(dr.width(a) for a in arrays))
    first = 0
    for a in arrays:
        dr.scatter(total, a, dr.arange(mi.UInt32, dr.width(a)) + first)
        first += dr.width(a)
    return total
