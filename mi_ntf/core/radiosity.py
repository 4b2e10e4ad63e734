"""Light that opaque skins send each other, as diffuse surfaces do: radiosity between patches, gathered by rays.

    E_i = D_i + Σ_j F_ij k_j E_j,        F_ij = share of the cosine-distributed rays from i that meet j

E: irradiance, D: that of the lights alone, k: albedo (Goral et al. 1984). A patch is a point of the skin: one for each
cell of a coarse grid and each of the six directions along the axes that normals of its skin are nearest to, so that
both sides of a thin sheet have their own. NumPy; renderer and trainer find patches and trace rays in their own ways.
"""

import numpy as np

CELLS = 48
"""Cells along an edge of [−1, 1]³: bounced light varies slowly, and a skin's cell is as wide as a patch."""
DEPTH = float(np.log(2.0))
"""Optical depth at which a ray has met a patch."""
RISE = 0.015
"""Where the rays of a patch begin, above it, in radii of the unit sphere: out of its own skin."""
CONVERGED = 1e-3
"""Change of any patch's irradiance by a further bounce, over the brightest's, from which on it is the last: of albedo
0.9, what is left out is nine times that."""
MOST_BOUNCES = 64
"""Ends what hardly loses light, as a closed white room: of albedo 0.9, 1e-3 of it is left after these."""
CHORDS = 1 << 16
"""Random lines through a field's sphere that look for its skin; rays from what they find look into its folds."""
STEPS = 256
"""Steps of all these rays across a sphere, at most: thinner sheets than 1/128 of its radius are seldom opaque."""
FEW = 4
"""Rays from a patch, squared, that look for further patches."""
SIDE = 12
"""Rays from a patch, squared, for its light: where a tenth of them meets something, the bounced light is right within a
quarter, and pictures show the mean of some patches."""


def face(normals: np.ndarray) -> np.ndarray:
    """Which of +x, −x, +y, −y, +z, −z each of the normals (n, 3) is nearest to."""
    axis = np.abs(normals).argmax(1)
    return 2 * axis + (normals[np.arange(len(normals)), axis] < 0)


def place(points: np.ndarray, normals: np.ndarray) -> tuple:
    """Index (4 arrays) of the points (n, 3) and their normals' faces in a table (6, z, y, x)."""
    x, y, z = np.clip(np.floor((points.T + 1) * (CELLS / 2)), 0, CELLS - 1).astype(int)
    return face(normals), z, y, x


def thin(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Indices of one of the points for each cell and face that has some: the first."""
    return np.unique(np.ravel_multi_index(place(points, normals), (6, *[CELLS] * 3)), return_index=True)[1]


def table(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Which patch stands for each face of each cell, (6, z, y, x) int32: its own; near the skin one of its neighbours',
    or of another face; −1 further away."""
    found = np.full((6, *[CELLS] * 3), -1, np.int32)
    found[place(points, normals)] = np.arange(len(points))
    found = own = _spread(_spread(found))
    for k in range(5):  # faces of other axes, then the opposite one
        others = [([g for g in range(6) if g // 2 != f // 2] + [f ^ 1])[k] for f in range(6)]
        found = np.where(found < 0, own[others], found)
    return _spread(found)


def _spread(found: np.ndarray) -> np.ndarray:
    """Empty cells take what a neighbour along an axis has."""
    result = found
    for axis in (1, 2, 3):
        for step in (1, -1):
            near = np.roll(found, step, axis)
            near[(slice(None),) * axis + (0 if step == 1 else -1,)] = -1
            result = np.where(result < 0, near, result)
    return result


def directions(normals: np.ndarray, side: int, rng: np.random.Generator) -> np.ndarray:
    """(n, side², 3): unit vectors above each normal, density cosine/π, one in each of side² strata."""
    n = len(normals)
    i, j = np.divmod(np.arange(side * side), side)
    u, v = (np.stack([i, j])[:, None] + rng.random((2, n, side * side))) / side
    radius, angle = np.sqrt(u), 2 * np.pi * v
    least = np.eye(3)[np.abs(normals).argmin(1)]
    a = np.cross(normals, least)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normals, a)
    parts = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u)
    return sum(p[..., None] * axis[:, None] for p, axis in zip(parts, (a, b, normals), strict=True))


def above(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Where light comes to the patches (n, 3), and their rays begin."""
    return points + RISE * normals


def rays(points: np.ndarray, normals: np.ndarray, side: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """``(o, d)``, (n · side², 3) each: origins and unit directions of the rays of the patches (n, 3), one patch after
    the other."""
    d = directions(normals, side, rng)
    o = np.broadcast_to(above(points, normals)[:, None], d.shape)
    return o.reshape(-1, 3), d.reshape(-1, 3)


def solve(hits: np.ndarray, albedo: np.ndarray, direct: np.ndarray, bounces: int) -> np.ndarray:
    """Irradiance that comes from other patches, (n, 3).

    hits     (n, rays): the patch that each ray meets, −1 for none
    albedo   (n, 3) in [0, 1]
    direct   (n, 3): irradiance by the lights alone
    bounces  how often light is sent on, at most; −1: until it changes by less than CONVERGED
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
