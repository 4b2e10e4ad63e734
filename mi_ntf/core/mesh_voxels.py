"""Voxels of a closed mesh: the fraction of each that lies inside."""

import numpy as np

LINES = 3
"""Lines along z through each voxel, along x and along y."""


def fraction_inside(vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray, counts: np.ndarray
                    ) -> np.ndarray:
    """Return the fraction (z, y, x), float32, of each voxel of a box that lies inside a closed mesh.

    Parameters
    ----------
    vertices, faces
        (n, 3) points, x first, and (m, 3) indices.
    low, high
        Corners of the box.
    counts
        Number of voxels along x, y and z.

    Notes
    -----
    Lines along z sample the voxels. A line is inside between its first and second crossing of the mesh, its third and
    fourth, and so on, so the orientation of faces does not matter. Its length inside each voxel is exact.
    """
    nx, ny, nz = (int(n) for n in counts)
    # In units of lines along x and y, and of voxels along z.
    place = (np.asarray(vertices, np.float64) - low) / (np.asarray(high, np.float64) - low) * [
        nx * LINES, ny * LINES, nz]
    line, z = _crossings(place[faces], nx * LINES, ny * LINES)
    order = np.lexsort((z, line))
    line, z = line[order], np.clip(z[order], 0, nz)
    first = np.searchsorted(line, line)  # of the same line
    sign = np.where((np.arange(len(line)) - first) % 2, -1.0, 1.0)
    voxel = np.minimum(z.astype(int), nz - 1)
    x, y = line % (nx * LINES) // LINES, line // (nx * LINES) // LINES
    column = y * nx + x
    within, above = (np.bincount(voxel * (nx * ny) + column, weight, nx * ny * nz).reshape(nz, ny, nx)
                     for weight in (sign * (voxel + 1 - z), sign))
    result: np.ndarray = within
    result[1:] += np.cumsum(above, 0)[:-1]
    return np.clip(result / LINES**2, 0, 1).astype(np.float32)


def _crossings(corners: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the line, x fastest, and z of each crossing of a line with triangles (m, corner, xyz).

    Lines lie at irrational places, so that none meets an edge.
    """
    offset = np.array([np.sqrt(2) - 1, np.sqrt(3) - 1])
    plane = corners[..., :2] - offset
    begin = np.clip(np.ceil(plane.min(1)).astype(int), 0, [width, height])
    size = np.maximum(np.clip(np.floor(plane.max(1)).astype(int) + 1, 0, [width, height]) - begin, 0)
    area = size.prod(1)
    triangle = np.repeat(np.arange(len(corners)), area)
    number = np.arange(area.sum()) - np.repeat(np.cumsum(area) - area, area)
    wide = np.maximum(size[triangle, 0], 1)
    x, y = begin[triangle, 0] + number % wide, begin[triangle, 1] + number // wide
    a, b, c = (plane[triangle, k] - np.stack([x, y], 1) for k in range(3))
    weights = [p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))]
    total = weights[0] + weights[1] + weights[2]
    hit = (total != 0) & ((np.minimum.reduce(weights) >= 0) | (np.maximum.reduce(weights) <= 0))
    depth = sum(w[hit] * corners[triangle[hit], k, 2] for k, w in enumerate(weights)) / total[hit]
    return y[hit] * width + x[hit], depth
