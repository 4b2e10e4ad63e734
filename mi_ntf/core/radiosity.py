"""Bounced light between opaque skins as diffuse surfaces: radiosity between patches, gathered by rays.

    E_i = D_i + Σ_j F_ij k_j E_j,        F_ij = fraction of the cosine-distributed rays from i that meet j

E: irradiance, D: that of the lights alone, k: albedo (Goral et al. 1984). A patch is a point of the skin. There is one
for each cell of a coarse grid and each face, the axis direction nearest to the skin's normal, so that both sides of a
thin sheet have their own. NumPy; renderer and trainer find patches and trace rays in their own ways.
"""

import numpy as np

CELLS = 48
"""Cells along an edge of [−1, 1]³; bounced light varies slowly."""
DEPTH = float(np.log(2.0))
"""Optical depth at which a ray meets a patch: half of the light is absorbed."""
RISE = 0.015
"""Height above a patch at which its rays begin, field units: outside its own skin."""
CONVERGED = 1e-3
"""Bounces end when the largest change of a patch's irradiance, over the brightest's, falls below this. At albedo 0.9
the neglected light is nine times as much."""
MOST_BOUNCES = 64
"""Upper bound of the number of bounces: at albedo 0.9, 1e-3 of the light remains after these."""
CHORDS = 1 << 16
"""Random lines through a field's sphere that search for its skin."""
STEPS = 256
"""Largest number of steps of a ray across a sphere: sheets thinner than 1/128 of its radius are seldom opaque."""
FEW = 4
"""Square root of the number of rays from a patch that search for further patches."""
SIDE = 12
"""Square root of the number of rays from a patch that gather its light. If a tenth of them meets a patch, the bounced
light errs by a quarter, and pictures show the mean of several patches."""


def face(normals: np.ndarray) -> np.ndarray:
    """Return the face nearest to each of the normals (n, 3), as an index into +x, −x, +y, −y, +z, −z."""
    axis = np.abs(normals).argmax(1)
    result: np.ndarray = 2 * axis + (normals[np.arange(len(normals)), axis] < 0)
    return result


def place(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the index (4 arrays) of points (n, 3) and their normals' faces into a table (6, z, y, x)."""
    x, y, z = np.clip(np.floor((points.T + 1) * (CELLS / 2)), 0, CELLS - 1).astype(int)
    return face(normals), z, y, x


def thin(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the indices of the first point in each cell and face that has one."""
    return np.unique(np.ravel_multi_index(place(points, normals), (6, *[CELLS] * 3)), return_index=True)[1]


def table(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the patch that represents each face of each cell, (6, z, y, x) int32.

    Near the skin, cells and faces without a patch take that of a neighbour or of another face; −1 further away.
    """
    patch = np.full((6, *[CELLS] * 3), -1, np.int32)
    patch[place(points, normals)] = np.arange(len(points))
    patch = of_face = _spread(_spread(patch))
    for k in range(5):  # faces of other axes, then the opposite one
        other_faces = [([g for g in range(6) if g // 2 != f // 2] + [f ^ 1])[k] for f in range(6)]
        patch = np.where(patch < 0, of_face[other_faces], patch)
    return _spread(patch)


def _spread(patch: np.ndarray) -> np.ndarray:
    """Give empty cells the patch of a neighbour along an axis."""
    result = patch
    for axis in (1, 2, 3):
        for step in (1, -1):
            near = np.roll(patch, step, axis)
            near[(slice(None),) * axis + (0 if step == 1 else -1,)] = -1
            result = np.where(result < 0, near, result)
    return result


def directions(normals: np.ndarray, side: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors (n, side², 3) above each normal, density cosine/π, one in each of side² strata."""
    n = len(normals)
    i, j = np.divmod(np.arange(side * side), side)
    u, v = (np.stack([i, j])[:, None] + rng.random((2, n, side * side))) / side
    radius, angle = np.sqrt(u), 2 * np.pi * v
    least = np.eye(3)[np.abs(normals).argmin(1)]
    a = np.cross(normals, least)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normals, a)
    parts = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u)
    result: np.ndarray = sum(p[..., None] * axis[:, None] for p, axis in zip(parts, (a, b, normals), strict=True))
    return result


def above(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the points above the patches (n, 3) that receive light and at which rays begin."""
    return points + RISE * normals


def rays(points: np.ndarray, normals: np.ndarray, side: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and unit directions, (n · side², 3) each, of the rays of the patches (n, 3), patch by patch."""
    d = directions(normals, side, rng)
    o = np.broadcast_to(above(points, normals)[:, None], d.shape)
    return o.reshape(-1, 3), d.reshape(-1, 3)


def solve(hits: np.ndarray, albedo: np.ndarray, direct: np.ndarray, bounces: int) -> np.ndarray:
    """Return the irradiance from other patches, (n, 3).

    Parameters
    ----------
    hits
        (n, rays): the patch that each ray meets, −1 for none.
    albedo
        (n, 3), in [0, 1].
    direct
        (n, 3): irradiance by the lights alone.
    bounces
        Maximum number of bounces; −1: until the irradiance changes by less than CONVERGED.
    """
    light = np.zeros_like(direct)
    if not len(direct):
        return light
    for _ in range(MOST_BOUNCES if bounces < 0 else min(bounces, MOST_BOUNCES)):
        sent = np.concatenate([albedo * (direct + light), np.zeros((1, direct.shape[1]))])
        before, light = light, np.stack([c[hits].mean(1) for c in sent.T], 1)
        if np.abs(light - before).max() <= CONVERGED * max(float(light.max()), 1e-30):
            break
    return light
