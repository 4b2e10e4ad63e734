"""Mesh of `animal`: smooth, nearly convex, diffuse, one bounce: its skin alone decides how bright its field is under
other lights than that at the camera.

Run: `python scenes/animal/make_mesh.py`. Deterministic; writes `meshes/animal.ply`.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "common"))
from sdf import blend, cone, ellipsoid, polygonise, write_ply


def animal():
    """Body, head, snout, four legs, two ears and a tail; y up, it looks along +z."""
    legs = [cone((s * 0.2, 0.51, z), (s * 0.21, 0.07, z + 0.03), 0.11, 0.085) for s in (-1, 1) for z in (-0.28, 0.28)]
    ears = [cone((s * 0.14, 1.17, 0.47), (s * 0.26, 1.38, 0.42), 0.077, 0.026) for s in (-1, 1)]
    return blend(0.05, ellipsoid((0, 0.72, 0), (0.36, 0.41, 0.53)), ellipsoid((0, 1.02, 0.53), (0.24, 0.23, 0.255)),
                 cone((0, 0.97, 0.72), (0, 0.95, 0.85), 0.11, 0.094), *legs, *ears,
                 cone((0, 0.85, -0.51), (0, 1.02, -0.66), 0.043, 0.026))


if __name__ == "__main__":
    mesh = polygonise(animal(), (-0.6, -0.1, -0.85), (0.6, 1.5, 1.1), 0.013)
    write_ply(mesh, Path(__file__).parent / "meshes" / "animal.ply", (0.09, 0.05, -0.05))
