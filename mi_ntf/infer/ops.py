"""Dr.Jit's namespace of elementary functions for the formulas of :mod:`mi_ntf.core` (see :mod:`mi_ntf.core.ops`).

``maximum`` and ``minimum`` pass a NaN on, as their NumPy and PyTorch twins do: a fault of the field then shows in the
image rather than turning into a plausible 0. Use ``dr.fmax`` where suppression is meant. Needs a Mitsuba variant or
Dr.Jit arrays of a back end; NumPy arrays and plain numbers mix in as literals.
"""

import drjit as dr

sqrt, exp, log, sin, cos, abs = dr.sqrt, dr.exp, dr.log, dr.sin, dr.cos, dr.abs
maximum, minimum = dr.maximum, dr.minimum


def where(condition, a, b):
    """`a` where `condition` holds, else `b`, elementwise."""
    return dr.select(condition, a, b)
