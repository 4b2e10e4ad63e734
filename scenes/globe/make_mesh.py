"""Meshes of `globe`: an openwork globe of rods and land plates around a core, tilted in a mount on a stand.

Run: `python scenes/globe/make_mesh.py`. Deterministic; writes one PLY a material into `meshes/`.
Local frame: y up, globe centred at the origin with radius 0.62. The thinnest rod has a radius of 0.027, that is 0.026
of the object's bounding sphere, so that photographs 128 pixels wide still show it.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "common"))
from sdf import blend, cone, disc, drop_covered, ellipsoid, intersection, polygonise, torus, union, write_ply

OFFSET = (-0.30, 1.10, 0.20)
RADIUS, ROD = 0.62, 0.027
TILT = np.radians(23.4)
AXIS = np.array([np.sin(TILT), np.cos(TILT), 0.0])
EAST = np.array([np.cos(TILT), -np.sin(TILT), 0.0])
NORTH_WEST = np.cross(EAST, AXIS)


def rod_ring(centre, axis, ring: float, tube: float) -> trimesh.Trimesh:
    """Torus mesh with exact normals: a parametric one needs a quarter of the triangles of marching cubes."""
    u, v = np.meshgrid(np.arange(72) * 2 * np.pi / 72, np.arange(12) * 2 * np.pi / 12, indexing="ij")
    n = np.asarray(axis) / np.linalg.norm(axis)
    e = np.cross(n, EAST if abs(n @ EAST) < 0.9 else AXIS)
    e /= np.linalg.norm(e)
    radial = np.cos(u)[..., None] * e + np.sin(u)[..., None] * np.cross(n, e)
    normal = np.cos(v)[..., None] * radial + np.sin(v)[..., None] * n
    i, j = np.meshgrid(np.arange(72), np.arange(12), indexing="ij")
    a, b, c, d = (x % 72 * 12 + y % 12 for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    points = np.asarray(centre) + ring * radial + tube * normal
    return trimesh.Trimesh(points.reshape(-1, 3), faces, vertex_normals=normal.reshape(-1, 3), process=False)


def lattice() -> trimesh.Trimesh:
    """Six great circles through the poles and five parallels, the equator thicker."""
    rings = [rod_ring((0, 0, 0), np.cos(a) * EAST + np.sin(a) * NORTH_WEST, RADIUS, ROD)
             for a in np.linspace(0, np.pi, 7)[:-1]]
    rings += [rod_ring(RADIUS * np.sin(b) * AXIS, AXIS, RADIUS * np.cos(b), 1.35 * ROD if b == 0 else ROD)
              for b in np.radians([-54.0, -27.0, 0.0, 27.0, 54.0])]
    normals = np.concatenate([r.vertex_normals for r in rings])
    merged = trimesh.util.concatenate(rings)
    return trimesh.Trimesh(merged.vertices, merged.faces, vertex_normals=normals, process=False)


def land():
    """Plates in the sphere's shell: where a sum of seven plane waves of the direction is high."""
    rng = np.random.default_rng(5)
    waves, phases = rng.normal(size=(7, 3)) * 2.6, rng.uniform(0, 2 * np.pi, 7)

    def distance(p):
        r = np.linalg.norm(p, axis=-1)
        u = p / np.maximum(r, 1e-6)[..., None]
        height = np.sin(u @ waves.T + phases).sum(-1)
        shell = np.abs(r - RADIUS) - 0.030
        coast = (1.0 - height) * 0.12
        k = 0.02  # rounded rims
        h = np.maximum(k - np.abs(shell - coast), 0.0) / k
        return np.maximum(shell, coast) + 0.25 * k * h * h

    return intersection(distance, lambda p: 0.3 - np.linalg.norm(p, axis=-1))


def mount():
    """Axis rod with end balls, and the ring that carries it, from the north pole down to the column."""
    ring = torus((0, 0, 0), (0, 0, 1), 0.74, 0.034)
    half = intersection(ring, lambda p: np.minimum(p @ EAST, np.maximum(p[..., 1], p[..., 0] - 0.06)) - 0.03)
    ends = [ellipsoid(s * 0.74 * AXIS, 0.062) for s in (-1, 1)]
    return blend(0.02, half, cone(-0.74 * AXIS, 0.74 * AXIS, 0.028), *ends)


def stand():
    """Turned column on a stepped foot."""
    rings = [disc((0, y, 0), r, 0.028, 0.02) for y, r in ((-0.80, 0.085), (-0.865, 0.11))]
    column = blend(0.03, cone((0, -0.74, 0), (0, -0.98, 0), 0.048, 0.062), *rings)
    foot = blend(0.03, disc((0, -1.03, 0), 0.40, 0.045, 0.03), disc((0, -0.97, 0), 0.25, 0.045, 0.03))
    feet = [ellipsoid((0.33 * np.cos(a), -1.075, 0.33 * np.sin(a)), 0.05) for a in np.radians([30, 150, 270])]
    return union(blend(0.05, column, foot), *feet)


def main() -> None:
    """Mesh every material and write `meshes/*.ply`."""
    parts = {
        "land": (land(), (-0.67,) * 3, (0.67,) * 3, 0.0185),
        "mount": (mount(), (-0.82, -0.82, -0.10), (0.40, 0.82, 0.10), 0.0160),
        "stand": (stand(), (-0.43, -1.16, -0.43), (0.43, -0.66, 0.43), 0.0180),
        "core": (ellipsoid((0, 0, 0), 0.21), (-0.23,) * 3, (0.23,) * 3, 0.0210),
    }
    for name, (shape, low, high, step) in parts.items():
        others = union(*[other for key, (other, *_) in parts.items() if key != name])
        mesh = drop_covered(polygonise(shape, low, high, step), others, margin=1.2 * step)
        write_ply(mesh, Path(__file__).parent / "meshes" / f"{name}.ply", OFFSET)
    write_ply(lattice(), Path(__file__).parent / "meshes" / "lattice.ply", OFFSET)


if __name__ == "__main__":
    main()
