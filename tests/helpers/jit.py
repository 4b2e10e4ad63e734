"""NumPy to Dr.Jit."""

import mitsuba as mi
import numpy as np


def arrays(points) -> tuple:
    """The components of points (n, d), one Float each."""
    return tuple(mi.Float(np.ascontiguousarray(c, np.float32)) for c in np.asarray(points, np.float64).T)
