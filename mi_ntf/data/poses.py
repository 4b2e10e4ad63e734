"""Checks of camera poses: each one a rigid motion, all of them around one object and looking at it."""

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.schema import View


def check_rigid(c2w: np.ndarray, where: str, what: str) -> None:
    """Raise MiNtfError unless `c2w` (4, 4) is a rotation and a translation. `what` names the entry in messages."""
    rotation = c2w[:3, :3]
    gram, det = rotation.T @ rotation, float(np.linalg.det(rotation))
    scale = float(np.sqrt(max(np.trace(gram) / 3, 0.0)))
    if np.abs(c2w[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise MiNtfError(f"{where}: {what} is no rigid motion, its last row is {c2w[3].tolist()}; keep it 0 0 0 1")
    if scale == 0 or np.abs(gram / scale**2 - np.eye(3)).max() > 1e-3:
        raise MiNtfError(f"{where}: {what} is no rigid motion (its axes are not perpendicular or of unequal length, "
                         f"off by {np.abs(gram - np.eye(3)).max():.2g}); remove shear and scale")
    if det < 0:
        raise MiNtfError(f"{where}: {what} is mirrored (determinant {det:.3g}, handedness wrong); negate one column "
                         "of the rotation so that x points right, y up, z back")
    if abs(scale - 1) > 5e-4:
        raise MiNtfError(f"{where}: {what} is no rigid motion, its rotation is scaled by {scale:.6g}; divide the upper "
                         "left 3x3 by that")


def nearest_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest to all lines in the least-squares sense; None where the lines are (nearly) parallel.

    origins, directions (N, 3), unit directions; their sign does not matter. Minimises Σ |(1 - d dᵀ)(p - o)|².
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = across.mean(0)
    if np.linalg.eigvalsh(matrix)[0] < 1e-4:  # mean squared sine of the angles to the common direction: 0.6 degrees
        return None
    return np.linalg.solve(matrix, np.einsum("nij,nj->i", across, origins) / len(origins))


def check_views(views: list[View], center: np.ndarray | None) -> None:
    """Raise MiNtfError if the cameras stand at one place, or all look away from the object.

    `center` of the object (3,); None: the point nearest to all optical axes (no axis convention changes these lines).
    """
    c2w = np.stack([v.c2w for v in views])
    place, forward = c2w[:, :3, 3], -c2w[:, :3, 2]
    if len(views) > 1 and np.ptp(place, axis=0).max() < 1e-5 * np.abs(place).max():
        raise MiNtfError(f"{views[0].where}: all {len(views)} cameras stand at {place.mean(0).round(4).tolist()}; the "
                         "object must be seen from several places. If these are world-to-camera matrices, invert them")
    center = nearest_point(place, forward) if center is None else center
    if center is not None and (np.einsum("ni,ni->n", forward, center - place) < 0).all():
        raise MiNtfError(f"{views[0].where}: this and all {len(views)} cameras look away from the object at "
                         f"{center.round(4).tolist()}; OpenGL axes are expected (x right, y up, looks along -z), "
                         "these seem to be OpenCV's: negate the second and third column of every rotation")


def check_outside(views: list[View], center: np.ndarray, radius: float, how: str) -> None:
    """Raise MiNtfError if a camera is inside the object's sphere; `how` says where the sphere comes from."""
    away = np.array([np.linalg.norm(v.c2w[:3, 3] - center) for v in views]) / radius
    i = int(away.argmin())
    if away[i] < 1:
        raise MiNtfError(f"{views[i].where}: the camera is inside the object, {away[i]:.3g} radii from the centre of "
                         f"its sphere ({how}: center {center.round(4).tolist()}, radius {radius:.4g}); correct the "
                         "pose, or give a smaller 'unit_sphere', or tighter masks")
