"""The similarity between scene and field coordinates."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.architecture import Similarity
from ...core.errors import MiNtfError
from ...infer.types import Vector, Vector3

SCALES = (1e-12, 1e12)
"""Scene units per capture unit."""
LENGTHS = (1e-12, 1e12)
"""Scene units per field unit, whose cubes single precision still represents."""


class Frame:
    """Placement of a field in the scene: world = to_world · scale · (center + radius · field).

    length   scene units per field unit
    unit     the same, for kernels
    origin   centre of the unit sphere in the scene

    Its numbers are opaque to kernels, so that another placement compiles nothing. Raises MiNtfError if `to_world` is no
    similarity or the result exceeds single precision.
    """

    def __init__(self, similarity: Similarity, to_world: np.ndarray, scale: float) -> None:
        self._arguments = similarity, np.asarray(to_world, np.float64), scale
        linear = np.asarray(to_world, np.float64)[:3, :3] * scale
        gram = linear.T @ linear
        size = np.sqrt(np.trace(gram) / 3)
        if not size > 0 or np.abs(gram / size**2 - np.eye(3)).max() > 1e-3:
            raise MiNtfError(
                f"nrf medium: to_world {np.round(to_world, 4).tolist()} is no similarity (it shears or scales axes "
                "differently), under which density has no single unit; use rotation, translation and uniform scale"
            )
        self.length = float(size * similarity.radius)
        self.origin = linear @ np.asarray(similarity.center) + np.asarray(to_world, np.float64)[:3, 3]
        if not (LENGTHS[0] <= self.length <= LENGTHS[1] and np.abs(self.origin).max() <= LENGTHS[1]):
            raise MiNtfError(
                f"nrf medium: its object has radius {self.length:g} at {self.origin.tolist()}, in scene units, where "
                f"single precision reckons with radii from {LENGTHS[0]:g} and places up to {LENGTHS[1]:g}; change "
                "scale or to_world"
            )
        self._matrix: np.ndarray = linear / size
        self._rotation = mi.Matrix3f(self._matrix.tolist())
        self._inverse_rotation = mi.Matrix3f(self._matrix.T.tolist())
        self._origin: Vector3 = mi.Point3f(self.origin.tolist())
        self.unit = mi.Float(self.length)
        self._inverse_length = mi.Float(1 / self.length)
        dr.make_opaque(self._rotation, self._inverse_rotation, self._origin, self.unit, self._inverse_length)

    def moved(self, to_world: np.ndarray) -> Frame:
        """Return the placement after a further transform, a (4, 4) matrix."""
        similarity, before, scale = self._arguments
        return Frame(similarity, to_world @ before, scale)

    def point_to_field(self, p: Vector3) -> Vector:
        """Convert scene points to field coordinates."""
        x, y, z = self._inverse_rotation @ mi.Vector3f(p - self._origin) * self._inverse_length
        return x, y, z

    def direction_to_field(self, d: Vector3) -> Vector:
        """Convert unit vectors of the scene to unit vectors of the field."""
        x, y, z = self._inverse_rotation @ mi.Vector3f(d)
        return x, y, z

    def point_to_world(self, p: Vector | Vector3) -> Vector3:
        """Convert field points to scene coordinates."""
        return mi.Point3f(self._rotation @ mi.Vector3f(*p) * self.unit + self._origin)

    def direction_to_world(self, d: Vector | Vector3) -> Vector3:
        """Convert unit vectors of the field to unit vectors of the scene."""
        return mi.Vector3f(self._rotation @ mi.Vector3f(*d))

    @property
    def rotation(self) -> np.ndarray:
        """Rotation (3, 3) from the field to the scene."""
        return self._matrix

    def placement(self) -> tuple[bytes, bytes, float]:
        """Return a key that differs between different placements."""
        return self._matrix.tobytes(), self.origin.tobytes(), self.length

    def of_capture(self, similarity: Similarity) -> np.ndarray:
        """Return the (4, 4) matrix from capture coordinates, whose sphere is `similarity`, to scene coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3] = self._matrix * (self.length / similarity.radius)
        matrix[:3, 3] = self.origin - matrix[:3, :3] @ np.asarray(similarity.center)
        return matrix

    def world_to_field_numpy(self, p: np.ndarray, direction: bool = False) -> np.ndarray:
        """Convert (n, 3) scene points, or directions, to field coordinates in float64 on the host."""
        field: np.ndarray = p @ self._matrix if direction else (p - self.origin) @ self._matrix / self.length
        return field
