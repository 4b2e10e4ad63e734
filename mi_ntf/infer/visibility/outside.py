"""Transmittance towards a light from points that may lie outside the field: on surfaces, in other fields."""

import drjit as dr

from ...core import spheres
from .. import ops
from ..types import Float, Mask, UInt32, Vector, Visibility
from .attached_shadow import AttachedShadow


def tau(method: Visibility, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask,
        sun: Mask = None) -> Float:
    """Return the transmittance of `method` from the place where the ray from `x` enters the sphere, or `x` inside it.

    Arguments as in :class:`mi_ntf.infer.types.Visibility`. Methods know their rays inside the sphere alone: beyond it,
    a logistic that fits smoke would fall to 0. Rays that miss the sphere evaluate no method.
    """
    if isinstance(method, AttachedShadow):  # Dr.Jit loses the gradients of a field within a branch
        return method.tau(x, wi, distance, index, active, sun)
    hit, m, h = spheres.chord(ops, x, wi)
    here = spheres.coordinate(x, wi)
    way = dr.select(hit, dr.maximum(-h - here, 0), 0)
    entered = tuple(dr.select(way > 0, mi - h * di, xi) for mi, di, xi in zip(m, wi, x, strict=True))

    def through(x: Vector, wi: Vector, distance: Float, index: UInt32) -> Float:
        return method.tau(x, wi, distance, index, True, sun)

    return ops.if_stmt(
        (entered, tuple(wi), distance - way, index), active & hit & (here < h) & (way < distance), through,
        lambda *_: type(h)(1), label="outside")
