"""Elementary functions by name, so that one formula serves NumPy, Dr.Jit and PyTorch.

A formula of :mod:`mi_ntf.core` takes its arrays as scalars or component tuples and, as its first argument, a namespace
with ``sqrt exp log sin cos abs maximum minimum where``. This module holds the NumPy one, the float64 oracle; ``infer``
and ``train`` each hold theirs.
"""

import numpy as np

sqrt, exp, log, sin, cos, abs = np.sqrt, np.exp, np.log, np.sin, np.cos, np.abs
maximum, minimum, where = np.maximum, np.minimum, np.where


def dot(a, b):
    """Inner product of two 3-component tuples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """Vector product of two 3-component tuples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def normalize(ops, a, tiny=1e-20):
    """`a` over its length; a zero vector stays zero and has finite gradients."""
    scale = 1 / ops.sqrt(ops.maximum(dot(a, a), tiny))
    return a[0] * scale, a[1] * scale, a[2] * scale
