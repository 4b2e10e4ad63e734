"""Gaussian splats on a mesh, imported as voxels: ``results/splats.json``.

    python -m benchmarks.splats [--counts 5000 100000 1000000]

- ``import``: seconds and peak memory of `mi-ntf import`, a process of its own, and the size of the field
- ``transmittance``: root mean square error of random rays against the sum of error functions, and of rays that graze
  the splats; number of rays whose transmittance is from 1 to 99 %
- ``shadow``: relative root mean square error of a floor in the shadow of the splats, against that of the mesh
- ``lookup``: nanoseconds of the transmittance from a seen point in a random direction by the atlas, and by tracing the
  ellipsoids of the splats (Mitsuba's ``ellipsoids``) with each one's optical depth in closed form
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mi_ntf.core.splats import Splats, optical_depth
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.field import Field
from mi_ntf.infer.visibility.method import Options
from mi_ntf.render.maps import building
from mi_ntf.render.scene.media import find_media

from . import record, timing

sys.path.insert(0, str(record.ROOT / "tests"))
from helpers.splats import write_ply

MESH = record.ROOT / "scenes" / "animal" / "meshes" / "animal.ply"
RAYS, LOOKUPS, TRACED, SIZE, SPP = 400, 1 << 16, 1 << 11, 96, 64
"""Numbers of rays of the error, of lookups, of traced rays; pixels along a side and samples of the floor."""
DENSER, NEIGHBOURS = 8, 4
"""Points of the mesh for each splat, and areas of a splat that its own points are from."""
OPACITY, FLATTEST = 0.9, 0.4
"""Opacity of the splats, and least shortest axis over the longest."""
EXTENT = 3.5
"""Standard deviations at which a traced ellipsoid ends."""
MEASURE = """import resource, sys
from mi_ntf.cli import main
sys.argv = ["mi-ntf", "import", sys.argv[1], "-o", sys.argv[2], "--overwrite"]
try:
    main()
finally:
    print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


def imported(file: Path, field: Path) -> dict[str, float]:
    """Import a file of splats in another process; return seconds, peak memory (GiB) and size (MB)."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", MEASURE, str(file), str(field)], capture_output=True, text=True,
                          check=True)
    return {"seconds": time.perf_counter() - start, "gibibytes": float(done.stdout.split("peak")[-1]),
            "megabytes": field.stat().st_size / 1e6}


def fitted(mesh: trimesh.Trimesh, count: int) -> Splats:
    """Return `count` splats whose means and covariances are those of the surface around them, as training makes them.

    Each has the moments of the points of the surface next to it, on ``NEIGHBOURS`` times its share of the area. It then
    lies two standard deviations beneath them, so that a grazing ray meets an opaque layer. Discs of one size instead
    protrude from thin limbs.
    """
    points, faces = trimesh.sample.sample_surface(mesh, count * DENSER, seed=0)
    points = np.asarray(points)
    near = points[cKDTree(points).query(points[:count], NEIGHBOURS * DENSER)[1]]
    means = near.mean(1)
    near -= means[:, None]
    variances, axes = np.linalg.eigh(np.swapaxes(near, 1, 2) @ near / (NEIGHBOURS * DENSER))
    axes[:, :, 2] *= np.linalg.det(axes)[:, None]
    scales = np.sqrt(np.maximum(variances, FLATTEST**2 * variances[:, 2:]))
    normals = axes[:, :, 0]
    outward = np.sign(np.sum(normals * np.asarray(mesh.face_normals)[faces[:count]], 1, keepdims=True))
    centres = means - 2 * scales[:, :1] * outward * normals
    rotations = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return Splats(centres, scales, rotations, np.full(count, OPACITY), np.tile([0.6, 0.5, 0.4], (count, 1)))


def error(splats: Splats, field: Field) -> dict[str, float]:
    """Return the root mean square error of the transmittance of random rays through the box of the matter.

    The first half of the rays graze the splats. They pass a random one at a right angle to its shortest axis, one to
    five standard deviations above its centre.
    """
    rng = np.random.default_rng(0)
    out = rng.normal(size=(RAYS, 3))
    origins = field.center + 1.2 * field.radius * out / np.linalg.norm(out, axis=1, keepdims=True)
    low, high = splats.centres.min(0), splats.centres.max(0)
    targets = rng.uniform(low, high, (RAYS, 3))
    chosen = splats.take(rng.integers(0, len(splats), RAYS // 2))
    normals = chosen.normals() * np.sign(np.sum(chosen.normals() * out[: RAYS // 2], 1, keepdims=True))
    heights = rng.uniform(1, 5, (RAYS // 2, 1)) * chosen.scales.min(1)[:, None]
    targets[: RAYS // 2] = chosen.centres + heights * normals
    along = np.cross(normals, rng.normal(size=normals.shape))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    origins[: RAYS // 2] = targets[: RAYS // 2] - 3 * field.radius * along
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    truth = np.exp(-optical_depth(splats, origins, directions))
    squares = (field.transmittance(origins, directions) - truth) ** 2
    grazing, others = np.sqrt(squares.reshape(2, -1).mean(1)).tolist()
    return {"grazing": grazing, "random": others,
            "partly_clear_rays": int(((truth > 0.01) & (truth < 0.99)).sum())}


def floor(thing: dict[str, Any] | None, integrator: dict[str, Any]) -> np.ndarray:
    """Return the picture from above of a floor that a point light illuminates past `thing`, which is not in view."""
    camera = {"type": "orthographic", "near_clip": 0.001,
              "to_world": mi.ScalarTransform4f().look_at([0, -0.01, 0], [0, -1, 0], [0, 0, 1]).scale(2.5),
              "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb",
                       "rfilter": {"type": "box"}}}
    ground = mi.ScalarTransform4f().translate([0, -0.3, 0]).rotate([1, 0, 0], -90).scale(4)
    scene = mi.load_dict({"type": "scene", "sensor": camera, "integrator": integrator,
                          "floor": {"type": "rectangle", "to_world": ground},
                          "lamp": {"type": "point", "position": [1.5, 4.0, 1.0], "intensity": 20.0},
                          **({"thing": thing} if thing else {})})
    return np.array(mi.render(scene, spp=SPP, seed=mi.UInt32(1)))


def shadow(field: Field) -> float:
    """Return the relative error of the shadow of a field to that of the mesh."""
    mesh = {"type": "ply", "filename": str(MESH)}
    splats = floor(field.shape(), {"type": "nrf", "max_depth": 2})
    return relative_rmse(splats, floor(mesh, {"type": "direct"}))


def lookups(splats: Splats, field: Field) -> dict[str, Any]:
    """Return nanoseconds of a transmittance by the atlas and by tracing, and their ratio."""
    scene = mi.load_dict({"type": "scene", "field": field.shape(), "light": {"type": "constant"}})
    medium = find_media(scene)[0]
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(LOOKUPS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = splats.centres[rng.integers(0, len(splats), LOOKUPS)]
    x = tuple(medium.frame.point_to_field(mi.Point3f(*origins.T)))
    wi = tuple(medium.frame.direction_to_field(mi.Vector3f(*directions.T)))
    atlas = building.build("transmittance_atlas", medium, timing.table_of(directions[:1]), Options(2 / timing.SAMPLES))
    ellipsoids = _ellipsoids(splats)
    ray = mi.Ray3f(mi.Point3f(*origins[:TRACED].T),
                   mi.Vector3f(*directions[:TRACED].T))
    times = timing.rounds({
        "atlas": lambda: atlas.tau(x, wi, mi.Float(dr.inf), mi.UInt32(0), mi.Bool(True)),
        "traced": partial(_traced, ellipsoids, _columns(splats), ray)}, 5)
    scaled = {"atlas": [1e9 * t / LOOKUPS for t in times["atlas"]],
              "traced": [1e9 * t / TRACED for t in times["traced"]]}
    return {**{name: record.spread(t) for name, t in scaled.items()},
            "ratio": record.ratio(scaled["traced"], scaled["atlas"])}


def _ellipsoids(splats: Splats) -> mi.Scene:
    w, x, y, z = splats.rotations.T
    shape = {"type": "ellipsoids", "centers": mi.TensorXf(splats.centres.astype(np.float32)), "extent": EXTENT,
             "scales": mi.TensorXf(splats.scales.astype(np.float32)),
             "quaternions": mi.TensorXf(np.stack([x, y, z, w], 1).astype(np.float32))}
    return mi.load_dict({"type": "scene", "splats": shape})


def _columns(splats: Splats) -> list[Any]:
    """Return the columns that the closed form reads: centre, rows of the matrix to standard deviations, and peak."""
    local = np.swapaxes(splats.axes(), 1, 2) / splats.scales[:, :, None]
    return [mi.Float(np.ascontiguousarray(c, np.float32)) for c in (*splats.centres.T, *local.reshape(-1, 9).T,
                                                                   splats.peaks())]


def _traced(scene: mi.Scene, columns: list[Any], ray: Any) -> Any:
    """Return the transmittance of rays through all ellipsoids that they enter, as `volprim_rf_basic` steps."""
    def body(o: Any, depth: Any, active: Any) -> tuple[Any, ...]:
        hit = scene.ray_intersect_preliminary(mi.Ray3f(o, ray.d), active=active)
        active = active & hit.is_valid()
        c = [dr.gather(mi.Float, column, hit.prim_index, active) for column in columns]
        p, d = [a - b for a, b in zip(ray.o, c[:3], strict=True)], ray.d
        rows = [c[3:6], c[6:9], c[9:12]]
        q, v = ([sum(a * b for a, b in zip(row, vector, strict=True)) for row in rows] for vector in (p, d))
        a = dr.sqrt(sum(k * k for k in v))
        b = sum(k * j for k, j in zip(q, v, strict=True)) / a
        m2 = sum(k * k for k in q) - b * b
        term = c[12] * dr.exp(-0.5 * m2) * float(np.sqrt(np.pi / 2)) / a * (1 - dr.erf(b * float(np.sqrt(0.5))))
        return mi.Point3f(o + (hit.t + 1e-5) * ray.d), depth + dr.select(active, term, 0), active & (depth < 12)

    state = (mi.Point3f(ray.o), dr.zeros(mi.Float, dr.width(ray.o)), dr.full(mi.Bool, True, dr.width(ray.o)))
    return dr.exp(-dr.while_loop(state=state, cond=lambda o, depth, active: active, body=body, label="ellipsoids")[1])


def measured(count: int, folder: Path) -> dict[str, Any]:
    """Return all figures of `count` splats."""
    splats = fitted(trimesh.load(MESH, process=False), count)
    file, path = write_ply(folder / "splats.ply", splats), folder / f"{count}.safetensors"
    row: dict[str, Any] = {"import": imported(file, path)}
    print(count, row, file=sys.stderr)
    field = Field.load(path)
    for name, figure in (("shadow", lambda: shadow(field)), ("lookup", lambda: lookups(splats, field)),
                         ("transmittance", lambda: error(splats, field))):
        row[name] = figure()
        print(count, row, file=sys.stderr)
    return row


def main() -> None:
    """Measure and write the result."""
    given = record.options(__doc__, ("--counts", {"type": int, "nargs": "*", "default": [5_000, 100_000, 1_000_000]}))
    record.prepare()
    start, values = time.perf_counter(), {}
    with tempfile.TemporaryDirectory() as folder:
        for count in [1000] if given.quick else given.counts:
            values[str(count)] = measured(count, Path(folder))
    record.write("splats", values, start, given.out)


if __name__ == "__main__":
    main()
