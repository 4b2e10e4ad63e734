"""Camera poses: how they are made and checked, and the pixels on which cells of space fall.

A pose is an OpenGL camera-to-world matrix (4, 4): x points right, y up, and the camera looks along -z.
"""

from typing import NamedTuple

import numpy as np

from mi_ntf.core import spheres
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.schema import View


def view_directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit directions (count, 3) from the object to the cameras: a Fibonacci lattice, turned at random."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    lattice = np.asarray(spheres.fibonacci(count, 0.5)) * (1, -1, 1)
    return np.asarray(lattice @ (q * np.sign(np.diag(r))).T)


def camera_to_world(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the pose of a camera at `position` that looks at `target`, with y up (z up at the poles)."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross((0.0, 1.0, 0.0) if abs(back[1]) < 0.99 else (0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :] = np.stack([right, np.cross(back, right), back, position], -1)
    return c2w


class Footprint(NamedTuple):
    """Windows of pixels on which cells (K,) may fall, ends excluded. They are empty for cells behind the camera."""

    left: np.ndarray
    right: np.ndarray
    top: np.ndarray
    bottom: np.ndarray
    inside: np.ndarray  # (K,) bool: the cell's centre falls into the image

    def pixels(self, mask: np.ndarray) -> np.ndarray:
        """Return the number of True pixels of `mask` (H, W) in each window (K,), from a summed-area table."""
        sums = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), np.int32)
        sums[1:, 1:] = mask.cumsum(0, np.int32).cumsum(1, np.int32)
        row, flat = sums.shape[1], sums.ravel()
        bottom, top = self.bottom * row, self.top * row
        return np.asarray(flat[bottom + self.right] - flat[top + self.right] - flat[bottom + self.left]
                          + flat[top + self.left])


def footprint(cells: np.ndarray, edge: float, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray,
              size: tuple[int, int]) -> Footprint:
    """Return the windows of pixels on which cubic cells with centres `cells` (K, 3) and edge length `edge` may fall.

    `focal` and `principal` (2,) and `size` (width, height) are in pixels.
    """
    width, height = size
    x, y, z = c2w[:3, :3].T @ (cells - c2w[:3, 3]).T
    front = -z > edge
    safe = np.where(front, -z, 1.0)
    u = principal[0] + focal[0] * x / safe
    v = principal[1] - focal[1] * y / safe
    slant = np.sqrt(x * x + y * y + z * z) / safe  # a length along the ray also moves the pixel beside the axis
    reach = slant * (np.sqrt(3) / 2 * edge * focal.max()) / np.maximum(safe - edge, edge)  # half a cell's diagonal
    # Numbers in [0, width] are rounded down by the conversion to integers.
    left, right = (np.clip(u + s * reach + (s > 0), 0, width).astype(np.int32) for s in (-1, 1))
    top, bottom = (np.clip(v + s * reach + (s > 0), 0, height).astype(np.int32) for s in (-1, 1))
    inside = front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return Footprint(left, np.where(front, right, left), top, bottom, inside)


def nearest_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """Return the point (3,) nearest to all lines in the least-squares sense; None for (nearly) parallel lines.

    `origins` and unit `directions` are (N, 3); the sign of a direction does not matter. The point minimises
    Σ |(1 - d dᵀ)(p - o)|².
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = across.mean(0)
    if np.linalg.eigvalsh(matrix)[0] < 1e-4:  # mean squared sine of the angles to the common direction: 0.6 degrees
        return None
    return np.linalg.solve(matrix, np.einsum("nij,nj->i", across, origins) / len(origins))


def check_rigid(c2w: np.ndarray, where: str, entry: str) -> None:
    """Raise MiNtfError unless `c2w` (4, 4) is a rotation and a translation. `entry` names the matrix in messages."""
    rotation = c2w[:3, :3]
    gram, det = rotation.T @ rotation, float(np.linalg.det(rotation))
    scale = float(np.sqrt(max(np.trace(gram) / 3, 0.0)))
    if np.abs(c2w[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise MiNtfError(f"{where}: {entry} is no rigid motion, its last row is {c2w[3].tolist()}; keep it 0 0 0 1")
    if scale == 0 or np.abs(gram / scale**2 - np.eye(3)).max() > 1e-3:
        raise MiNtfError(f"{where}: {entry} is no rigid motion (its axes are not perpendicular or of unequal length, "
                         f"off by {np.abs(gram - np.eye(3)).max():.2g}); remove shear and scale")
    if det < 0:
        raise MiNtfError(f"{where}: {entry} is mirrored (determinant {det:.3g}, handedness wrong); negate one column "
                         "of the rotation so that x points right, y up, z back")
    if abs(scale - 1) > 5e-4:
        raise MiNtfError(f"{where}: {entry} is no rigid motion, its rotation is scaled by {scale:.6g}; divide the "
                         "upper left 3x3 by that")


def check_views(views: list[View], center: np.ndarray | None) -> None:
    """Raise MiNtfError if the cameras stand at one place, or all of them look away from the object.

    `center` (3,) is the object's. If it is None, it is the point nearest to all optical axes.
    """
    c2w = np.stack([v.c2w for v in views])
    place, forward = c2w[:, :3, 3], -c2w[:, :3, 2]
    given = center is not None
    center = nearest_point(place, forward) if center is None else center
    to_center = np.zeros_like(place) if center is None else center - place
    ahead = np.einsum("ni,ni->n", forward, to_center)
    # Georeferenced coordinates are far larger than the distances of cameras. Without a given centre these count only if
    # all cameras face it: axes that begin at one place meet there, and rounding puts that point behind some of them.
    lengths = to_center if given or (ahead > 0).all() else place
    if len(views) > 1 and np.ptp(place, axis=0).max() <= 1e-5 * np.abs(lengths).max():
        raise MiNtfError(f"{views[0].where}: all {len(views)} cameras stand at {place.mean(0).round(4).tolist()}; the "
                         "object must be seen from several places. If these are world-to-camera matrices, invert them")
    if center is not None and (ahead < 0).all():
        raise MiNtfError(f"{views[0].where}: this and all {len(views)} cameras look away from the object at "
                         f"{center.round(4).tolist()}; OpenGL axes are expected (x right, y up, looks along -z), "
                         "these seem to be OpenCV's: negate the second and third column of every rotation")


def check_outside(views: list[View], center: np.ndarray, radius: float, source: str) -> None:
    """Raise MiNtfError if a camera is inside the object's sphere, which comes from `source`."""
    distance = np.array([np.linalg.norm(v.c2w[:3, 3] - center) for v in views]) / radius
    i = int(distance.argmin())
    if distance[i] < 1:
        raise MiNtfError(f"{views[i].where}: the camera is inside the object, {distance[i]:.3g} radii from the centre "
                         f"of its sphere ({source}: center {center.round(4).tolist()}, radius {radius:.4g}); correct "
                         "the pose, or give a smaller 'unit_sphere', or tighter masks")
