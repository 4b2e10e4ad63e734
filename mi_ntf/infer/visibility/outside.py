"""Transmittance towards a light from points that may lie outside the field: on surfaces, in other fields."""

import drjit as dr

from ...core import spheres
from .. import ops


def tau(method, x, wi, distance, index, active):
    """``method.tau`` (:mod:`mi_ntf.infer.visibility`) from where the ray from `x` enters the sphere, `x` itself inside
    it. Tables know their rays inside the sphere alone: carried on behind it, a logistic that fits smoke falls to 0.
    Rays that pass by ask no method."""
    hit, m, h = spheres.chord(ops, x, wi)
    here = spheres.coordinate(x, wi)
    way = dr.select(hit, dr.maximum(-h - here, 0), 0)
    entered = tuple(dr.select(way > 0, mi - h * di, xi) for mi, di, xi in zip(m, wi, x, strict=True))

    def through(x, wi, distance, index):
        return method.tau(x, wi, distance, index, True)

    return dr.if_stmt(
        (entered, tuple(wi), distance - way, index), active & hit & (here < h) & (way < distance), through,
        lambda *_: type(h)(1), label="outside")
