"""Meshes of `statue`: a robed figure seated on a lotus pedestal, with a staff, an orb, a halo and a bead necklace.

Run: `python scenes/statue/make_mesh.py`. Deterministic; writes one PLY a material into `meshes/`.
Local frame: y up, the figure looks along +z, the pedestal stands on y = 0; `OFFSET` moves it to its place.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "common"))
from sdf import blend, carve, cone, disc, drop_covered, ellipsoid, intersection, polygonise, torus, union, write_ply

OFFSET = (0.1, 0.0, -0.05)
STAFF_X, STAFF_Z = -0.43, 0.27


def figure():
    """Body without hair: torso, crossed legs, one arm resting in the lap, one raised to the staff, the head."""
    torso = blend(0.10, cone((0, 0.44, -0.02), (0, 0.80, -0.01), 0.20, 0.17),
                  ellipsoid((0, 0.83, 0.0), (0.225, 0.15, 0.145)))
    legs = [cone((s * 0.13, 0.43, 0.0), (s * 0.37, 0.40, 0.17), 0.125, 0.105) for s in (-1, 1)]
    shins = [cone((-0.37, 0.40, 0.17), (0.10, 0.375, 0.33), 0.095, 0.06),
             cone((0.37, 0.40, 0.17), (-0.10, 0.40, 0.36), 0.095, 0.06)]
    lap = ellipsoid((0, 0.385, 0.10), (0.36, 0.085, 0.27))
    left = blend(0.05, cone((0.235, 0.905, -0.01), (0.345, 0.66, 0.05), 0.083, 0.070),
                 cone((0.345, 0.66, 0.05), (0.12, 0.545, 0.27), 0.068, 0.046),
                 ellipsoid((0.03, 0.535, 0.315), (0.095, 0.035, 0.06)))
    right = blend(0.05, cone((-0.235, 0.905, -0.01), (-0.385, 0.70, 0.06), 0.083, 0.070),
                  cone((-0.385, 0.70, 0.06), (STAFF_X + 0.02, 0.93, 0.235), 0.066, 0.045),
                  ellipsoid((STAFF_X, 0.97, STAFF_Z - 0.01), (0.052, 0.065, 0.058)))
    return blend(0.06, torso, *legs, *shins, lap, left, right)


def head():
    """Neck and head with a simple face: brow, nose, lips, closed eyes, long ears."""
    skull = blend(0.05, ellipsoid((0, 1.215, 0.0), (0.118, 0.135, 0.128)),
                  ellipsoid((0, 1.15, 0.03), (0.088, 0.09, 0.088)))
    neck = cone((0, 0.93, -0.01), (0, 1.12, 0.0), 0.075, 0.062)
    nose = blend(0.02, cone((0, 1.235, 0.115), (0, 1.175, 0.143), 0.010, 0.017),
                 ellipsoid((0, 1.170, 0.133), (0.025, 0.012, 0.014)))
    lips = union(ellipsoid((0, 1.133, 0.112), (0.032, 0.009, 0.018)),
                 ellipsoid((0, 1.119, 0.110), (0.025, 0.009, 0.018)))
    ears = union(*[ellipsoid((s * 0.120, 1.17, -0.005), (0.018, 0.066, 0.032)) for s in (-1, 1)])
    sockets = union(*[ellipsoid((s * 0.047, 1.205, 0.137), (0.032, 0.016, 0.022)) for s in (-1, 1)])
    lids = union(*[ellipsoid((s * 0.046, 1.202, 0.102), (0.028, 0.015, 0.021)) for s in (-1, 1)])
    face = carve(blend(0.025, skull, nose, lips, ears), sockets, 0.02)
    return blend(0.02, blend(0.05, face, neck), lids)


def robe(body):
    """Cloth over one shoulder, lap and legs: the body's surface moved out and folded, cut by a slanted neckline."""

    def cloth(p):
        x, y, z = np.moveaxis(p, -1, 0)
        chest = np.cos(58.0 * (0.85 * y + 0.5 * x) + 2.2 * np.sin(6.0 * x))
        knees = np.cos(52.0 * np.hypot(0.8 * x, z + 0.10) + 1.5 * np.sin(5.0 * x + 4.0 * y))
        mix = np.clip((y - 0.44) / 0.16, 0.0, 1.0)
        ridge = mix * chest + (1 - mix) * knees
        return body(p) - 0.022 - 0.016 * (1.6 * np.sqrt(0.5 + 0.5 * ridge) - 0.8)  # narrow valleys, broad ridges

    def neckline(p):
        x, y, z = np.moveaxis(p, -1, 0)
        edge = 0.81 + 0.62 * x - 0.25 * np.maximum(0.0, 0.06 - z) * (x < 0)
        return (y - edge) * 0.8

    def inside_hands(p):
        x, y, z = np.moveaxis(p, -1, 0)
        bare_arm = ((x + 0.235) * 0.86 + (y - 0.60) * 0.1 + 0.03)           # the raised arm stays bare
        bare_right = np.where(y > 0.56, -bare_arm, -1.0)
        bare_left = np.where((y > 0.485) & (z > 0.15) & (np.abs(x) < 0.19), z - 0.22, -1.0)
        return np.maximum(bare_right, bare_left)

    def hem(p):
        return 0.32 - p[..., 1]

    return intersection(cloth, neckline, inside_hands, hem)


def hair():
    """Cap of small curls and a topknot."""
    def hairline(p):
        return 1.5 * (1.245 - p[..., 1]) + 0.9 * p[..., 2] - 0.02

    cap = carve(ellipsoid((0, 1.235, -0.016), (0.128, 0.133, 0.130)), lambda p: -hairline(p), 0.01)
    knot = blend(0.03, ellipsoid((0, 1.372, -0.02), (0.062, 0.055, 0.062)),
                 ellipsoid((0, 1.425, -0.02), (0.03, 0.035, 0.03)))
    shape = blend(0.03, cap, knot)

    def curls(p):
        x, y, z = np.moveaxis(p, -1, 0)
        return shape(p) - 0.004 - 0.0055 * np.sin(95 * x) * np.sin(95 * y + 1.3) * np.sin(95 * z)

    return curls


def necklace(surface):
    """Beads hung over the chest: a curve in front of the body, dropped along -z onto `surface`."""
    beads = []
    for u in np.linspace(-1, 1, 17):
        p = np.array([0.155 * u, 0.80 + 0.165 * abs(u) ** 1.7, 0.5])
        for _ in range(64):
            p[2] -= 0.8 * float(surface(p))
        beads.append(ellipsoid((p[0], p[1], p[2] + 0.008), 0.026 if abs(u) < 0.01 else 0.0185))
    return union(*beads)


def gold():
    """Halo with balls and spokes, staff with a ringed head."""
    centre = np.array([0.0, 1.23, -0.15])
    parts = [torus(centre, (0, 0, 1), 0.30, 0.026)]
    for angle in np.linspace(-0.25 * np.pi, 1.25 * np.pi, 9):
        u = np.array([np.cos(angle), np.sin(angle), 0.0])
        parts += [ellipsoid(centre + 0.36 * u, 0.040), cone(centre + 0.30 * u, centre + 0.36 * u, 0.022)]
    parts.append(cone((0, 0.98, -0.17), (0, 0.93, -0.10), 0.035, 0.05))
    parts.append(cone((STAFF_X, 0.40, STAFF_Z), (STAFF_X, 1.36, STAFF_Z), 0.023))
    top = np.array([STAFF_X, 1.47, STAFF_Z])
    parts += [torus(top, (0, 0.2, 1), 0.085, 0.021), ellipsoid((STAFF_X, 1.36, STAFF_Z), (0.04, 0.03, 0.04)),
              ellipsoid((STAFF_X, 1.585, STAFF_Z), 0.038)]
    return blend(0.015, *parts)


def petals(count: int, ring: float, y: float, size, lean: float, phase: float):
    """Return one ring of lotus petals: ellipsoids that lean outwards by `lean` radians."""
    shapes = []
    for angle in 2 * np.pi * (np.arange(count) + phase) / count:
        c, s, cl, sl = np.cos(angle), np.sin(angle), np.cos(lean), np.sin(lean)
        frame = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array([[cl, sl, 0], [-sl, cl, 0], [0, 0, 1]])
        base, centre = ellipsoid((0, 0, 0), size), np.array([ring * c, y, -ring * s])
        shapes.append(lambda p, f=frame, m=centre, b=base: b((p - m) @ f))
    return union(*shapes)


def pedestal():
    """Stepped round base with a beaded moulding."""
    beads = [ellipsoid((0.485 * np.cos(a), 0.128, 0.485 * np.sin(a)), 0.040)
             for a in np.linspace(0, 2 * np.pi, 29)[:-1]]
    return union(disc((0, 0.05, 0.05), 0.56, 0.05, 0.02), disc((0, 0.10, 0.05), 0.515, 0.03, 0.012),
                 disc((0, 0.19, 0.05), 0.39, 0.09, 0.02), disc((0, 0.30, 0.05), 0.43, 0.03, 0.02),
                 *[lambda p, b=b: b(p - (0, 0, 0.05)) for b in beads])


def main() -> None:
    """Mesh every material and write `meshes/*.ply`."""
    body, face = figure(), head()
    cloth = robe(body)
    skin = intersection(blend(0.02, body, face), lambda p: 0.30 - p[..., 1])
    lotus = union(petals(14, 0.41, 0.215, (0.030, 0.085, 0.088), 0.55, 0.0),
                  petals(14, 0.385, 0.285, (0.028, 0.075, 0.08), 0.25, 0.5))
    parts = {
        "skin": (skin, (-0.56, 0.28, -0.28), (0.50, 1.40, 0.46), 0.0145),
        "robe": (cloth, (-0.56, 0.28, -0.32), (0.56, 1.12, 0.50), 0.0160),
        "hair": (hair(), (-0.17, 1.12, -0.19), (0.17, 1.50, 0.17), 0.0105),
        "gold": (union(gold(), necklace(union(skin, cloth))), (-0.58, 0.36, -0.25), (0.46, 1.68, 0.36), 0.0130),
        "lotus": (lambda p: lotus(p - (0, 0, 0.05)), (-0.56, 0.10, -0.50), (0.56, 0.40, 0.60), 0.0190),
        "stone": (pedestal(), (-0.60, -0.03, -0.56), (0.60, 0.37, 0.66), 0.0225),
        "orb": (ellipsoid((0.02, 0.640, 0.315), 0.082), (-0.08, 0.54, 0.22), (0.12, 0.74, 0.41), 0.0125),
    }
    for name, (shape, low, high, step) in parts.items():
        others = union(*[other for key, (other, *_) in parts.items() if key != name])
        mesh = drop_covered(polygonise(shape, low, high, step), others, margin=1.2 * step)
        write_ply(mesh, Path(__file__).parent / "meshes" / f"{name}.ply", OFFSET)


if __name__ == "__main__":
    main()
