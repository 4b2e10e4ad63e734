"""The sRGB curve (IEC 61966-2-1), for every framework (:mod:`mi_ntf.core.ops`)."""


def encode(ops, linear):
    """Linear values, clipped to [0, 1], encoded."""
    x = ops.minimum(ops.maximum(linear, 0.0), 1.0)
    # The power sees no zero, where its slope is infinite.
    return ops.where(x <= 0.0031308, 12.92 * x, 1.055 * ops.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def decode(ops, encoded):
    """Inverse of :func:`encode`, for values in [0, 1]."""
    return ops.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
