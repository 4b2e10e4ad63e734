"""Meshes of `knot`: a glossy trefoil knot with a fluted tube, in bands of three colours.

Run: `python scenes/knot/make_mesh.py`. Deterministic; writes one PLY a colour into `meshes/`.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "common"))
from sdf import write_ply

OFFSET = (0.40, 0.60, -0.30)
ALONG, AROUND, BANDS = 540, 48, 18  # ring count, vertices a ring, colour bands (ALONG divides by BANDS)
COLOURS = ("teal", "ivory", "crimson")


def centre_line(t: np.ndarray) -> np.ndarray:
    """Trefoil, the (2,3) torus knot, leaned back a little; t in radians, (..., 3)."""
    ring = 0.50 + 0.225 * np.cos(3 * t)
    x, y, z = ring * np.cos(2 * t), ring * np.sin(2 * t), 0.30 * np.sin(3 * t)
    lean = np.radians(-20.0)
    return np.stack([x, np.cos(lean) * y - np.sin(lean) * z, np.sin(lean) * y + np.cos(lean) * z], -1)


def tube() -> trimesh.Trimesh:
    """The closed tube with smooth normals. Faces are ordered along the knot."""
    t = 2 * np.pi * np.arange(ALONG) / ALONG
    p, eps = centre_line(t), 1e-4
    tangent = centre_line(t + eps) - centre_line(t - eps)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    side = np.cross(tangent, p - p.mean(0))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    a = 2 * np.pi * np.arange(AROUND) / AROUND
    u = np.cos(a)[:, None] * side[:, None] + np.sin(a)[:, None] * np.cross(tangent, side)[:, None]
    radius = 0.155 + 0.006 * np.cos(BANDS * t)[:, None]  # each band bulges
    vertices = p[:, None] + radius[..., None] * u
    i, j = np.meshgrid(np.arange(ALONG), np.arange(AROUND), indexing="ij")
    i1, j1 = (i + 1) % ALONG, (j + 1) % AROUND
    v00, v01, v10, v11 = (x * AROUND + y for x, y in ((i, j), (i, j1), (i1, j), (i1, j1)))
    faces = np.stack([np.stack([v00, v11, v01], -1), np.stack([v00, v10, v11], -1)], 2).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def main() -> None:
    """Split the tube's faces into bands and write one file a colour."""
    mesh = tube()
    normals = np.array(mesh.vertex_normals)
    band = np.arange(len(mesh.faces)) // (2 * AROUND) * BANDS // ALONG
    for k, name in enumerate(COLOURS):
        used, faces = np.unique(mesh.faces[band % len(COLOURS) == k], return_inverse=True)
        part = trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), vertex_normals=normals[used], process=False)
        write_ply(part, Path(__file__).parent / "meshes" / f"{name}.ply", OFFSET)


if __name__ == "__main__":
    main()
