"""Signed distance functions and their meshing, shared by the scripts that make the scenes' meshes.

A shape is a function `f(p) -> d`: p (..., 3) points in scene units, d (...) signed distance (negative inside; only
bounds of the true distance after `blend`, `ellipsoid` or a displacement, which marching cubes does not mind).
Formulas: Inigo Quilez, "distance functions" and "smooth minimum".
"""

from collections.abc import Callable
from functools import reduce
from pathlib import Path

import numpy as np
import trimesh
from skimage.measure import marching_cubes

Shape = Callable[[np.ndarray], np.ndarray]


def ellipsoid(centre, radii) -> Shape:
    """Axis-aligned ellipsoid; a sphere where `radii` is one number."""
    c, r = np.asarray(centre, float), np.broadcast_to(np.asarray(radii, float), 3)

    def distance(p):
        q = (p - c) / r
        k0, k1 = np.linalg.norm(q, axis=-1), np.linalg.norm(q / r, axis=-1)
        return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)

    return distance


def cone(a, b, ra, rb=None) -> Shape:
    """Capsule from a to b whose radius goes linearly from ra to rb (default: ra)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    rb = ra if rb is None else rb

    def distance(p):
        u = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
        return np.linalg.norm(p - a - u[..., None] * (b - a), axis=-1) - (ra + u * (rb - ra))

    return distance


def torus(centre, axis, ring: float, tube: float) -> Shape:
    """Torus of ring radius `ring` around `axis`, tube radius `tube`."""
    c, n = np.asarray(centre, float), np.asarray(axis, float) / np.linalg.norm(axis)

    def distance(p):
        h = (p - c) @ n
        rho = np.linalg.norm(p - c - h[..., None] * n, axis=-1)
        return np.hypot(rho - ring, h) - tube

    return distance


def disc(centre, radius: float, half_height: float, rounding: float = 0.0) -> Shape:
    """Upright (y) cylinder with rounded edges; the sizes include the rounding."""
    c = np.asarray(centre, float)

    def distance(p):
        q = p - c
        x = np.hypot(q[..., 0], q[..., 2]) - (radius - rounding)
        y = np.abs(q[..., 1]) - (half_height - rounding)
        outside = np.hypot(np.maximum(x, 0), np.maximum(y, 0))
        return outside + np.minimum(np.maximum(x, y), 0) - rounding

    return distance


def union(*shapes: Shape) -> Shape:
    """Sharp union."""
    return lambda p: reduce(np.minimum, (s(p) for s in shapes))


def intersection(*shapes: Shape) -> Shape:
    """Sharp intersection."""
    return lambda p: reduce(np.maximum, (s(p) for s in shapes))


def blend(k: float, *shapes: Shape) -> Shape:
    """Union with a fillet about k wide (polynomial smooth minimum)."""

    def smooth_min(a, b):
        h = np.maximum(k - np.abs(a - b), 0.0) / k
        return np.minimum(a, b) - 0.25 * k * h * h

    return lambda p: reduce(smooth_min, (s(p) for s in shapes))


def carve(shape: Shape, tool: Shape, k: float = 0.01) -> Shape:
    """`shape` without `tool`, the edge softened over k."""

    def distance(p):
        a, b = shape(p), -tool(p)
        h = np.maximum(k - np.abs(a - b), 0.0) / k
        return np.maximum(a, b) + 0.25 * k * h * h

    return distance


def polygonise(shape: Shape, low, high, step: float) -> trimesh.Trimesh:
    """Marching cubes of `shape` in the box [low, high] at grid spacing `step`, normals from the shape's gradient."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    count = np.ceil((high - low) / step).astype(int) + 1
    axes = [low[i] + step * np.arange(count[i]) for i in range(3)]
    values = np.stack([shape(np.stack(np.broadcast_arrays(x, *np.meshgrid(*axes[1:], indexing="ij")), -1))
                       for x in axes[0]])
    if min(values[0].min(), values[-1].min(), values[:, 0].min(), values[:, -1].min(), values[:, :, 0].min(),
           values[:, :, -1].min()) <= 0:
        raise ValueError(f"polygonise: the shape reaches the border of the box {low} .. {high}; enlarge the box")
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(step,) * 3, gradient_direction="descent")
    vertices = vertices.astype(np.float64) + low
    eps = 0.25 * step
    normals = np.stack([shape(vertices + eps * e) - shape(vertices - eps * e) for e in np.eye(3)], -1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)


def drop_covered(mesh: trimesh.Trimesh, others: Shape, margin: float) -> trimesh.Trimesh:
    """`mesh` without the triangles that lie deeper than `margin` inside the `others` and are never seen."""
    hidden = (others(np.asarray(mesh.vertices)) < -margin)[mesh.faces].all(1)
    used, faces = np.unique(mesh.faces[~hidden], return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), vertex_normals=mesh.vertex_normals[used],
                           process=False)


def write_ply(mesh: trimesh.Trimesh, path: Path, offset=(0.0, 0.0, 0.0)) -> None:
    """Write binary PLY with float32 positions and vertex normals, moved by `offset`."""
    points = np.asarray(mesh.vertices) + np.asarray(offset)
    vertices = np.concatenate([points, mesh.vertex_normals], 1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    names = "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz"))
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}"
              f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
    print(f"{path.name}: {len(vertices)} vertices, {len(faces)} triangles, {path.stat().st_size / 1e6:.2f} MB")
