"""Transmittance towards a light from points that may lie outside the field: on surfaces, in other fields."""

import drjit as dr

from ...core import spheres
from .. import ops


def tau(method, x, wi, distance, index, active):
    """``method.tau`` (:mod:`mi_ntf.infer.visibility`) from where the ray from `x` enters the sphere, `x` itself inside
    it. Tables know their rays inside the sphere alone: carried on behind it, a logistic that fits smoke falls to 0."""
    hit, m, h = spheres.chord(ops, x, wi)
    way = dr.select(hit, dr.maximum(-h - spheres.coordinate(x, wi), 0), 0)
    entered = tuple(dr.select(way > 0, mi - h * di, xi) for mi, di, xi in zip(m, wi, x, strict=True))
    before = way < distance
    return dr.select(before, method.tau(entered, wi, distance - way, index, active & before), 1)
