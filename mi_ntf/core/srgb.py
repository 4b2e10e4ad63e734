"""The sRGB curve (IEC 61966-2-1), for every framework (:mod:`mi_ntf.core.ops`)."""

from .ops import Array, Ops


def encode(ops: Ops, linear: Array) -> Array:
    """Encode linear values, clipped to [0, 1]."""
    x = ops.minimum(ops.maximum(linear, 0.0), 1.0)
    # The power's slope is infinite at 0.
    return ops.where(x <= 0.0031308, 12.92 * x, 1.055 * ops.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def decode(ops: Ops, encoded: Array) -> Array:
    """Return the linear values of encoded ones in [0, 1]; the inverse of :func:`encode`."""
    return ops.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
