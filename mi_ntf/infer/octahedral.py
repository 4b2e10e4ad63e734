"""Directions as cells of a square, n × n of them, each next to its neighbours on the sphere but across the seams, where
:func:`wrap` finds them (Engelhardt and Dachsbacher 2008). `side`: n, a float."""

import drjit as dr


def place(w, side):
    """Cell coordinates of the unit direction `w`; whole numbers are the cells' centres."""
    scale = dr.rcp(dr.abs(w[0]) + dr.abs(w[1]) + dr.abs(w[2]))
    a, b = _fold(w[0] * scale, w[1] * scale, w[2] < 0)
    half = side * 0.5
    return (a + 1) * half - 0.5, (b + 1) * half - 0.5


def direction(tu, tv, side):
    """Unit direction through the centre of cell (tu, tv)."""
    step = 2 * dr.rcp(side)
    a, b = (tu + 0.5) * step - 1, (tv + 0.5) * step - 1
    z = 1 - dr.abs(a) - dr.abs(b)
    a, b = _fold(a, b, z < 0)
    norm = dr.rsqrt(a * a + b * b + z * z)
    return a * norm, b * norm, z * norm


def wrap(tu, tv, side):
    """The cell that lies where (tu, tv), up to one cell outside, would: an edge meets its own mirror image."""
    last = side - 1
    tv = dr.select((tu < 0) | (tu > last), last - tv, tv)
    tu = dr.clip(tu, 0, last)
    tu = dr.select((tv < 0) | (tv > last), last - tu, tu)
    return tu, dr.clip(tv, 0, last)


def _fold(a, b, lower):
    """The lower half of the octahedron, folded out; its own inverse."""
    fa = (1 - dr.abs(b)) * dr.select(a < 0, -1, 1)
    fb = (1 - dr.abs(a)) * dr.select(b < 0, -1, 1)
    return dr.select(lower, fa, a), dr.select(lower, fb, b)
