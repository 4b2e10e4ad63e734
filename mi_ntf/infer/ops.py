"""Dr.Jit's namespace of elementary functions for the formulas of :mod:`mi_ntf.core` (see :mod:`mi_ntf.core.ops`).

``maximum`` and ``minimum`` propagate NaN, as their NumPy and PyTorch twins do: a fault of the field then shows in the
picture instead of becoming a plausible 0. ``fmax`` and ``fmin`` suppress it. The functions need Dr.Jit arrays of a back
end; NumPy arrays and numbers mix in as literals.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager

import drjit as dr

from .types import Array, Mask

sqrt, exp, log, sin, cos = dr.sqrt, dr.exp, dr.log, dr.sin, dr.cos
maximum, minimum = dr.maximum, dr.minimum
abs: Callable[[Array], Array] = dr.abs
# Older releases of Dr.Jit have no fmax; their maximum suppresses NaN.
fmax: Callable[[Array, Array], Array] = getattr(dr, "fmax", dr.maximum)
fmin: Callable[[Array, Array], Array] = getattr(dr, "fmin", dr.minimum)

# The stubs of these functions have types that no call with arrays of an unknown back end satisfies.
if_stmt: Callable[..., Array] = dr.if_stmt
while_loop: Callable[..., Array] = dr.while_loop
replace_grad: Callable[[Array, Array], Array] = dr.replace_grad
isolate_grad: Callable[[], AbstractContextManager[None]] = dr.isolate_grad
resume_grad: Callable[[], AbstractContextManager[None]] = dr.resume_grad
suspend_grad: Callable[[], AbstractContextManager[None]] = dr.suspend_grad


def where(condition: Mask, a: Array, b: Array) -> Array:
    """Return `a` where `condition` holds, else `b`, elementwise."""
    return dr.select(condition, a, b)
