"""Volumes of the gallery's scenes: smoke by a formula, Gaussian splats on a mesh, and a NeRF's grid.

    python docs/gallery/assets.py

It writes ``assets/smoke.vol``, ``assets/splats.ply`` and ``assets/nerf.npz``. `mi-ntf import` makes fields of the last
two. Files that are there stay.
"""

import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from mi_ntf.core.mesh_voxels import fraction_inside

GALLERY = Path(__file__).parent
SCENES, ASSETS = GALLERY.parents[1] / "scenes", GALLERY / "assets"
SMOKE_VOXELS = 96
"""Voxels of the smoke along x and z."""
SPLATS, LAYERS, FLATNESS, OPACITY = 40_000, 8.0, 0.3, 0.9
"""Number of splats, mean number of them over a point of the surface, shortest over longest axis, and opacity."""
NERF_VOXELS, NERF_DENSITY = 192, 150.0
"""Voxels along the longest side of the NeRF's grid, and density inside the object, 1/scene unit."""


def smoke() -> np.ndarray:
    """Return the density (z, y, x), 0 to 1, of a plume that rises along y and bends in the wind."""
    rng, shape = np.random.default_rng(7), (SMOKE_VOXELS, SMOKE_VOXELS * 3 // 2, SMOKE_VOXELS)
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    place = np.stack([z, y * 1.5, x])
    warp = np.stack([_noise(place * 4, 3, rng) for _ in range(2)])
    across = np.hypot(x - 0.28 - 0.34 * y**2 + 0.04 * warp[0] * y, z - 0.5 + 0.04 * warp[1] * y)
    inside = 1 - across / (0.05 + 0.3 * y**0.8) + 0.4 * _noise(place * 6, 4, rng) * np.sqrt(y)
    dome = np.hypot(across / 0.4, np.maximum(y - 0.6, 0) / 0.36)
    sides = np.clip(np.minimum.reduce([x, 1 - x, z, 1 - z]) / 0.08, 0, 1)
    return np.clip(2.5 * (inside - 0.6 * np.clip(dome - 0.3, 0, None)), 0, 1) * np.clip(y / 0.03, 0, 1) * sides


def _noise(place: np.ndarray, octaves: int, rng: np.random.Generator) -> np.ndarray:
    """Return noise of unit variance at `place` (3, …), whose amplitudes halve as frequencies double."""
    total = np.zeros(place.shape[1:])
    for octave in range(octaves):
        total += 0.5**octave * map_coordinates(rng.normal(size=(16,) * 3), place * 2**octave, order=3, mode="grid-wrap")
    return total / total.std()


def splats() -> bytes:
    """Return a .ply of Gaussian splatting: flat discs just beneath the surface of the mesh of `animal`."""
    mesh, rng = trimesh.load(SCENES / "animal/meshes/animal.ply"), np.random.default_rng(0)
    points, faces = trimesh.sample.sample_surface(mesh, SPLATS, seed=0)
    normals, radius = mesh.face_normals[faces], np.sqrt(LAYERS * mesh.area / SPLATS / (2 * np.pi))
    half = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(SPLATS)], 1)  # turns z to the normal
    half[half[:, 0] < 1e-6] = (0, 1, 0, 0)
    spots = _noise(np.moveaxis(points * 9, -1, 0), 1, rng)[:, None] > 0.9
    belly = np.clip((0.65 - points[:, 1:2]) / 0.25, 0, 1)
    colour = np.where(spots, (0.93, 0.88, 0.78), (1 - belly) * (0.78, 0.52, 0.30) + belly * (0.85, 0.74, 0.60))  # sRGB
    columns = {"x y z": points - 2 * FLATNESS * radius * normals, "f_dc_0 f_dc_1 f_dc_2": (colour - 0.5) / 0.28209479,
               "opacity": np.full((SPLATS, 1), np.log(OPACITY / (1 - OPACITY))),
               "scale_0 scale_1 scale_2": np.tile(np.log(radius * np.array([1, 1, FLATNESS])), (SPLATS, 1)),
               "rot_0 rot_1 rot_2 rot_3": half / np.linalg.norm(half, axis=1, keepdims=True)}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {SPLATS}",
              *(f"property float {name}" for name in " ".join(columns).split()), "end_header", ""]
    return "\n".join(header).encode() + np.concatenate(list(columns.values()), 1).astype("<f4").tobytes()


def nerf() -> dict[str, np.ndarray]:
    """Return density, colours and box of a grid around the meshes of `knot`, as programs of NeRF export them."""
    root = ET.parse(SCENES / "knot/mesh.xml").getroot()
    meshes = {name: trimesh.load(SCENES / f"knot/meshes/{name}.ply") for name in ("teal", "ivory", "crimson")}
    colours = {name: root.find(f"bsdf[@id='{name}']/bsdf/rgb").get("value").split(",") for name in meshes}
    mesh = trimesh.util.concatenate(list(meshes.values()))
    low, high = mesh.bounds[0] - 0.03, mesh.bounds[1] + 0.03
    size = (high - low).max() / NERF_VOXELS
    counts = np.ceil((high - low) / size).astype(int)
    high = low + counts * size
    inside = gaussian_filter(fraction_inside(mesh.vertices, mesh.faces, low, high, counts), 1.2)  # as smooth as a NeRF
    inside[inside < 0.01] = 0
    places = low + (np.argwhere(inside > 0)[:, ::-1] + 0.5) * size
    nearest = cKDTree(mesh.vertices).query(places)[1]
    of_vertex = np.repeat(np.array(list(colours.values()), float), [len(m.vertices) for m in meshes.values()], axis=0)
    rgb = np.zeros((*inside.shape, 3), np.float32)
    rgb[inside > 0] = of_vertex[nearest]
    weight = gaussian_filter((inside > 0).astype(np.float32), 1.2)[..., None]
    rgb = np.clip(gaussian_filter(rgb, (1.2, 1.2, 1.2, 0)) / np.maximum(weight, 1e-3), 0, 1) * (inside > 0)[..., None]
    return {"sigma": (NERF_DENSITY * inside).astype(np.float32), "rgb": rgb, "aabb": np.stack([low, high])}


def _write_smoke(path: Path) -> None:
    mi.VolumeGrid(smoke()[..., None].astype(np.float32)).write(str(path))


FILES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "smoke": ("smoke.vol", _write_smoke),
    "splats": ("splats.ply", lambda path: path.write_bytes(splats())),
    "nerf": ("nerf.npz", lambda path: np.savez_compressed(path, **nerf())),
}
"""Scene → file and the function that writes it."""


def make(scenes: Iterable[str]) -> None:
    """Write the missing files of `scenes`, and import them."""
    ASSETS.mkdir(exist_ok=True)
    for name, write in (FILES[scene] for scene in scenes if scene in FILES):
        path = ASSETS / name
        if not path.exists():
            write(path)
        field = path.with_suffix(".safetensors")
        if path.suffix != ".vol" and not field.exists():  # Mitsuba reads a .vol itself
            subprocess.run([sys.executable, "-m", "mi_ntf", "import", path, "-o", field], check=True)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    make(FILES)
