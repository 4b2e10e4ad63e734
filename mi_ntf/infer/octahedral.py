"""Directions as cells of a square of `side` × `side` cells (Engelhardt and Dachsbacher 2008).

Neighbouring cells are neighbours on the sphere, except across the seams, where :func:`wrap` finds them. `side` is a
float.
"""

import drjit as dr

from . import ops
from .types import Array, Float, Mask, Vector


def place(w: Vector, side: Float) -> tuple[Float, Float]:
    """Return the cell coordinates of the unit direction `w`; whole numbers are the cells' centres."""
    scale = dr.rcp(ops.abs(w[0]) + ops.abs(w[1]) + ops.abs(w[2]))
    a, b = _fold(w[0] * scale, w[1] * scale, w[2] < 0)
    half = side * 0.5
    return (a + 1) * half - 0.5, (b + 1) * half - 0.5


def direction(tu: Float, tv: Float, side: Float) -> tuple[Float, Float, Float]:
    """Return the unit direction through the centre of cell (tu, tv)."""
    step = 2 * dr.rcp(side)
    a, b = (tu + 0.5) * step - 1, (tv + 0.5) * step - 1
    z = 1 - dr.abs(a) - dr.abs(b)
    a, b = _fold(a, b, z < 0)
    norm = dr.rsqrt(a * a + b * b + z * z)
    return a * norm, b * norm, z * norm


def wrap(tu: Float, tv: Float, side: Float) -> tuple[Float, Float]:
    """Return the cell of the square for (tu, tv), which is up to one cell outside: an edge meets its mirror image."""
    last = side - 1
    tv = dr.select((tu < 0) | (tu > last), last - tv, tv)
    tu = dr.clip(tu, 0, last)
    tu = dr.select((tv < 0) | (tv > last), last - tu, tu)
    return tu, dr.clip(tv, 0, last)


def _fold(a: Array, b: Array, lower: Mask) -> tuple[Array, Array]:
    """Fold out the lower half of the octahedron; the function is its own inverse."""
    fa = (1 - dr.abs(b)) * dr.select(a < 0, -1, 1)
    fb = (1 - dr.abs(a)) * dr.select(b < 0, -1, 1)
    return dr.select(lower, fa, a), dr.select(lower, fb, b)
