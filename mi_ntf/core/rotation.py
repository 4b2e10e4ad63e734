"""Rotations in space."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def about(axis: ArrayLike, degrees: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation about `axis`, counter-clockwise seen from its tip (Rodrigues' formula)."""
    cross = np.cross(np.eye(3), np.asarray(axis, np.float64) / np.linalg.norm(axis))
    angle = np.radians(degrees)
    matrix: NDArray[np.float64] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return matrix
