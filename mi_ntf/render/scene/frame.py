"""The similarity between scene and field coordinates."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.architecture import Similarity
from ...core.errors import MiNtfError

SCALES = (1e-12, 1e12)
"""Scene units per capture unit."""
LENGTHS = (1e-12, 1e12)
"""Scene units per field unit: cubes of it are still numbers in single precision."""


class Frame:
    """world = to_world · scale · (center + radius · field).

    length   scene units per field unit
    origin   the unit sphere's centre in the scene
    Arrays go into kernels as opaque values: another placement compiles nothing anew.
    """

    def __init__(self, similarity: Similarity, to_world: np.ndarray, scale: float):
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
        self._matrix = linear / size
        self._rotation = mi.Matrix3f(self._matrix.tolist())
        self._back = mi.Matrix3f(self._matrix.T.tolist())
        self._origin = mi.Point3f(self.origin.tolist())
        self._inverse = mi.Float(1 / self.length)
        dr.make_opaque(self._rotation, self._back, self._origin, self._inverse)

    def point_to_field(self, p):
        """Scene point → 3-tuple of field coordinates."""
        return tuple(self._back @ mi.Vector3f(p - self._origin) * self._inverse)

    def direction_to_field(self, d):
        """Unit vector of the scene → unit 3-tuple."""
        return tuple(self._back @ mi.Vector3f(d))

    def point_to_world(self, p):
        """3-tuple of field coordinates → scene point."""
        return mi.Point3f(self._rotation @ mi.Vector3f(*p) * self.length + self._origin)

    def direction_to_world(self, d):
        """Unit 3-tuple → unit vector of the scene."""
        return mi.Vector3f(self._rotation @ mi.Vector3f(*d))

    def placement(self) -> tuple:
        """Numbers that tell frames apart."""
        return self._matrix.tobytes(), self.origin.tobytes(), self.length

    def of_capture(self, similarity: Similarity) -> np.ndarray:
        """Return the (4, 4) matrix that takes coordinates of the capture, whose sphere is `similarity`, to the scene's.
        """
        matrix = np.eye(4)
        matrix[:3, :3] = self._matrix * (self.length / similarity.radius)
        matrix[:3, 3] = self.origin - matrix[:3, :3] @ np.asarray(similarity.center)
        return matrix

    def world_to_field_numpy(self, p: np.ndarray, direction: bool = False) -> np.ndarray:
        """(n, 3) scene points (or directions) → field, in float64 on the host."""
        return p @ self._matrix if direction else (p - self.origin) @ self._matrix / self.length
