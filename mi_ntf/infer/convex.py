"""Convex bodies that bound a medium: the part of a ray inside, and a test for points."""

from types import ModuleType

import drjit as dr
import numpy as np

from ..core.ops import dot
from . import ops
from .types import Float, Mask, Place, Vector

PARALLEL = 1e-9
"""Cosine to a plane's normal below which a ray counts as parallel to the plane."""


class Convex:
    """An intersection of half-spaces ⟨n, p⟩ ≤ c and, optionally, of a ball around the origin; field coordinates.

    Parameters
    ----------
    planes
        (k, 4): outward unit normal n and offset c of each half-space.
    radius
        Radius of the ball, at most 1; None: there is no ball.
    dj
        Dr.Jit module of the back end.

    Notes
    -----
    All numbers are opaque to kernels: bodies of the same number of planes share their kernels.
    """

    nbytes = resolution = 0

    def __init__(self, planes: np.ndarray, radius: float | None, dj: ModuleType):
        self.planes, self.radius = np.asarray(planes, np.float64).reshape(-1, 4), radius
        self._planes = [tuple(dr.opaque(dj.Float, float(c)) for c in row) for row in self.planes]
        self._squared = None if radius is None else dr.opaque(dj.Float, radius * radius)

    def extent(self, m: Vector, d: Vector, h: Float) -> tuple[Float, Float]:
        """Return begin and end, t', of the part of the chord m + t' d, |t'| ≤ h, inside; end < begin if there is none.

        `m` is the middle of the chord of the unit sphere, perpendicular to `d`.
        """
        begin, end = -h, h
        if self._squared is not None:
            half = dr.sqrt(dr.maximum(self._squared - dot(m, m), 0))
            begin, end = dr.maximum(begin, -half), dr.minimum(end, half)
        for *normal, offset in self._planes:
            rate, room = dot(normal, d), offset - dot(normal, m)
            t = room / dr.select(ops.abs(rate) < PARALLEL, PARALLEL, rate)
            leaves, enters = rate >= PARALLEL, rate <= -PARALLEL
            end = dr.select(leaves, dr.minimum(end, t), end)
            begin = dr.select(enters, dr.maximum(begin, t), begin)
            end = dr.select(~leaves & ~enters & (room < 0), -2, end)
        return begin, end

    def arrays(self) -> list[np.ndarray]:
        """Return the numbers that define the body."""
        return [self.planes, np.array([self.radius or 0.0])]

    def place(self, p: Vector) -> Place:
        """Return a mask of the points `p` that lie inside, first, and what else :meth:`clear_distance` needs."""
        return (self.inside(p),)

    def clear_distance(self, place: Place, inverse_d: Vector) -> Float:
        """Return the distance from a :meth:`place` along which a ray stays outside, or 0; inside the extent, 0."""
        return 0

    def inside(self, p: Vector) -> Mask:
        """Return True where the points `p` lie inside."""
        result: Mask = True
        if self._squared is not None:
            result = dot(p, p) <= self._squared
        for *normal, offset in self._planes:
            result = result & (dot(normal, p) <= offset)
        return result


def box(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the six planes of the axis-aligned box between two corners."""
    axes = np.eye(3)
    return np.concatenate([np.column_stack([axes, high]), np.column_stack([-axes, -np.asarray(low)])])


def planes_of(vertices: np.ndarray, faces: np.ndarray, most: int = 16) -> np.ndarray | None:
    """Return the planes (k, 4) of a closed convex mesh, or None if it is not convex or has more than `most` planes.

    `vertices`: (n, 3); `faces`: (m, 3) indices. Planes of coplanar faces are merged.
    """
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    size = np.ptp(vertices, axis=0).max()
    good = area > 1e-10 * size * size
    normal, a = normal[good] / area[good, None], a[good]
    outward = np.sign(np.einsum("ij,ij->i", normal, a - vertices.mean(0)))
    normal *= np.where(outward == 0, 1, outward)[:, None]
    rows = np.column_stack([normal, np.einsum("ij,ij->i", normal, a)])
    merged: list[np.ndarray] = []
    for row in rows:
        parallel = [other for other in merged if row[:3] @ other[:3] > 1 - 1e-8]
        if any(abs(other[3] - row[3]) > 1e-5 * size for other in parallel):
            return None
        if not parallel:
            merged.append(row)
        if len(merged) > most:
            return None
    planes = np.array(merged)
    convex = len(merged) >= 4 and (vertices @ planes[:, :3].T <= planes[:, 3] + 1e-5 * size).all()
    return planes if convex else None
