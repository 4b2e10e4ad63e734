"""Shipped fields beside their path-traced meshes: ``results/fields.json``.

    python -m benchmarks.fields [STUDY …] [--scenes statue globe …] [--photographs FOLDER] [--depth 2]

- ``brightness``: mean brightness of the field over that of the meshes − 1, and relative RMSE, as it is and after one
  factor a channel, under a flash at the camera, a lamp, a sun, a constant sky and one of high contrast
- ``photographs``: PSNR and SSIM (both sRGB) of views that were not trained on, lit as the photographs were, and the
  mean angle in degrees between shading normals of field and meshes, over pixels that both fill
- ``transmittance``: relative RMSE of the transmittance network and of maps of 128² and 256² texels to ``raymarch`` on
  the same field, under 50 directional lights, and nanoseconds of a query of the network

A scene is the name of a folder of scenes/, or a folder with ``mesh.xml``, ``scene.xml`` and ``field.safetensors``.
Photographs are captured anew unless ``--photographs`` names a data set. ``--depth`` is ``max_depth`` of the study of
brightness; for others than 2 it adds the part of the mean that the bounces beyond the first contribute. Takes about 5
minutes on two cores.
"""

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.capture import capture
from mi_ntf.data.images import linear
from mi_ntf.data.readers import load_dataset
from mi_ntf.data.schema import Split
from mi_ntf.evaluate import metrics
from mi_ntf.infer.profile import DepthProfile
from mi_ntf.infer.tuning import NETWORK_STEP

from . import record, scenes, timing

NAMES = ("statue", "globe", "knot")
CELLS = 256
"""Lights that stand for an environment in the study of brightness."""
FILLED = 0.98
"""Opacity above which a pixel's normal counts; silhouettes mix it with the background."""
WAYS: dict[str, dict[str, Any]] = {
    "ray_network": {"visibility": "ray_network"},
    "map, field, 128²": {"visibility": "transmittance_map", "map_resolution": 128},
    "map, field, 256²": {"visibility": "transmittance_map", "map_resolution": 256},
    "map, network, 128²": {"visibility": "transmittance_map", "map_source": "network", "map_resolution": 128},
    "map, network, 256²": {"visibility": "transmittance_map", "map_source": "network", "map_resolution": 256},
}


@dataclass(frozen=True)
class Sizes:
    """Amounts that are measured.

    - brightness: pixels along a side, samples of the meshes and of the field
    - photographs: test views, pixels along a side, samples of the photographs and of the field
    - transmittance: pixels along a side, samples, lights, network queries
    """

    brightness: tuple[int, int, int] = (96, 256, 16)
    photographs: tuple[int, int, int, int] = (10, 128, 256, 32)
    transmittance: tuple[int, int, int, int] = (128, 4, 50, 1 << 20)


FULL = Sizes()
QUICK = Sizes((24, 16, 2), (1, 24, 8, 2), (24, 1, 2, 1 << 10))


def lights(loaded: Any) -> dict[str, dict[str, Any]]:
    """Return emitters by name; a viewer of the scene's sphere sees long shadows of the lamp and of the sun."""
    camera = np.array(loaded.sensors()[0].world_transform().translation()).ravel()
    box = loaded.bbox()
    centre, radius = np.array(box.center()), np.linalg.norm(np.array(box.extents())) / 2
    distance = float(np.linalg.norm(camera - centre))
    sky = np.full((16, 32, 3), 0.1, np.float32)
    sky[4:6, 20:23] = 20, 18, 15
    sky[6:8, 4:9] = 2, 3, 5
    lamp = (centre + radius * np.array([1.4, 1.8, 2.7])).tolist()
    return {
        "flash": {"type": "point", "position": camera.tolist(), "intensity": distance**2},
        "lamp": {"type": "point", "position": lamp, "intensity": float((3 * radius) ** 2)},
        "sun": {"type": "directional", "direction": [1, -1.2, -0.7], "irradiance": 3.0},
        "constant": {"type": "constant", "radiance": 1.0},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
    }


def brightness(mesh: Path, field: Path, sizes: Sizes = FULL, depth: int = 2) -> dict[str, dict[str, float]]:
    """Return ``brightness``, ``relative_rmse`` and ``aligned`` by light.

    Where `depth` is not 2, ``bounces`` and ``mesh_bounces`` are added.
    """
    size, *samples = sizes.brightness
    original: Any = mi.load_file(str(mesh), res=str(size))
    bodies = {"mesh": {f"shape{i}": s for i, s in enumerate(original.shapes())},
              "field": {"ball": scenes.field_ball(field)}}
    spp = dict(zip(bodies, samples, strict=True))
    integrators: dict[str, dict[str, Any]] = {"mesh": {"type": "path"},
                                              "field": {"type": "nrf", "environment_lights": CELLS}}
    sensor, rows = original.sensors()[0], {}

    def image(kind: str, light: dict[str, Any], depth: int) -> np.ndarray:
        integrator = {**integrators[kind], "max_depth": depth, "hide_emitters": True}
        loaded = mi.load_dict({"type": "scene", "integrator": integrator, "light": light, **bodies[kind]})
        return np.array(mi.render(loaded, sensor=sensor, spp=spp[kind]), np.float64)[..., :3]

    for name, light in lights(original).items():
        truth, lit = (image(kind, light, depth) for kind in bodies)
        rows[name] = {"brightness": float(lit.mean() / truth.mean() - 1),
                      "relative_rmse": metrics.relative_rmse(lit, truth),
                      "aligned": metrics.relative_rmse(lit * metrics.alignment(lit, truth), truth)}
        if depth != 2:
            for key, whole, kind in (("mesh_bounces", truth, "mesh"), ("bounces", lit, "field")):
                rows[name][key] = float(whole.mean() / image(kind, light, 2).mean() - 1)
    return rows


def photographs(field: Path, dataset: Path, mesh: Path | None = None, spp: int = 32) -> dict[str, Any]:
    """Return PSNR (dB), SSIM and with `mesh` the error of normals (degrees) over the test views of a data set."""
    split = load_dataset(dataset, lambda note: None)["test"]
    ball = scenes.field_ball(field)
    originals = None if mesh is None else mi.load_file(str(mesh))
    psnr, ssim, angles = [], [], []
    for i, stored in enumerate(split.images):
        photograph = linear(stored)
        view = sensor(split, i)
        lamp = {"type": "point", "position": split.light_pos[i].tolist(),
                "intensity": {"type": "rgb", "value": split.light_intensity[i].tolist()}}
        integrator = {"type": "nrf", "max_depth": -1, "aovs": "normal,opacity" if mesh else ""}
        loaded = mi.load_dict({"type": "scene", "integrator": integrator, "lamp": lamp, "ball": ball})
        seed: Any = i  # a number, where Mitsuba's stub asks for an array
        image = np.array(mi.render(loaded, sensor=view, spp=spp, seed=seed))
        truth = photograph[..., :3].astype(np.float64)
        psnr.append(metrics.psnr(image[..., :3], truth))
        ssim.append(metrics.ssim(image[..., :3], truth))
        if originals is not None:
            filled = (image[..., 7] > FILLED) & (photograph[..., 3] > 0.999)
            angles.append(_angles(image[..., 4:7], _normals(originals, view, spp))[filled])
    result: dict[str, Any] = {"psnr": record.spread(psnr), "ssim": record.spread(ssim),
                              "mean_psnr": float(np.mean(psnr)), "mean_ssim": float(np.mean(ssim))}
    return result | ({"normal_error": float(np.nanmean(np.concatenate(angles)))} if angles else {})


def sensor(split: Split, i: int) -> Any:
    """Return the camera of a view. Raises MiNtfError where Mitsuba has no such camera."""
    height, width = split.images.shape[1:3]
    fx, fy = split.focal[i]
    if abs(fx - fy) > 1e-3 * fx or np.abs(split.principal[i] - [width / 2, height / 2]).max() > 0.5:
        raise MiNtfError(f"view {i}: focal lengths {fx:.5g}, {fy:.5g} and principal point "
                         f"{split.principal[i].tolist()}, expected square pixels and a centred camera")
    to_world = split.c2w[i] @ np.diag([-1, 1, -1, 1])  # OpenGL → Mitsuba axes
    return mi.load_dict({
        "type": "perspective", "fov_axis": "x", "fov": float(2 * np.degrees(np.arctan(width / 2 / fx))),
        "near_clip": 1e-4, "far_clip": 1e6, "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
                 "pixel_format": "rgba"},
        "sampler": {"type": "independent"},
    })


def _normals(originals: Any, view: Any, spp: int) -> np.ndarray:
    """Return the mean shading normals (h, w, 3) of the meshes, not normalised."""
    integrator = mi.load_dict({"type": "aov", "aovs": "normal:sh_normal"})
    return np.array(mi.render(originals, sensor=view, integrator=integrator, spp=spp))[..., -3:]


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the degrees between the vectors of two images; NaN where one is no normal, or mixed at an edge."""
    lengths = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    cosine = (a * b).sum(-1) / np.maximum(lengths[0] * lengths[1], 1e-6)
    return np.where(np.minimum(*lengths) > 0.9, np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.nan)


def transmittance(scene: Path, sizes: Sizes = FULL) -> dict[str, Any]:
    """Return the relative RMSE of each of `WAYS`, and ``query_ns``, nanoseconds of a query of the network."""
    size, spp, count, queries = sizes.transmittance
    loaded = scenes.with_lights(mi.load_file(str(scene), res=str(size)), count)
    images = {name: scenes.picture(loaded, scenes.integrator(**properties), 0, spp)[0]
              for name, properties in ({"raymarch": {"visibility": "raymarch"}} | WAYS).items()}
    truth = images.pop("raymarch")
    errors = {name: metrics.relative_rmse(image, truth) for name, image in images.items()}
    return errors | {"query_ns": query_time(scenes.medium_of(loaded), queries)}


def query_time(medium: Any, count: int) -> dict[str, float]:
    """Return nanoseconds of a ray of the network's query, features included, on chords through the field's box."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(3, count))
    direction /= np.linalg.norm(direction, axis=0)
    low, high = medium.field.grid.bounds
    place = (low + rng.uniform(size=(count, 3)) * (high - low)).T
    x, d = (tuple(mi.Float(c.astype(np.float32)) for c in v) for v in (place, direction))
    profile = DepthProfile(medium.source, dr.opaque(mi.Float, NETWORK_STEP * 2 / 384))
    times = timing.rounds({"query": lambda: medium.field.network.ray_mixture(x, d, profile)[2]}, 5)
    return record.spread(1e9 * t / count for t in times["query"])


def study(name: str, folder: Path, sizes: Sizes, dataset: Path | None, depth: int) -> dict[str, Any]:
    """Return the rows of one study of the scene in `folder`."""
    mesh, field = folder / "mesh.xml", folder / "field.safetensors"
    if name == "brightness":
        return brightness(mesh, field, sizes, depth)
    if name == "transmittance":
        return transmittance(folder / "scene.xml", sizes)
    views, size, mesh_spp, spp = sizes.photographs
    if dataset is not None:
        return photographs(field, dataset, mesh, spp)
    with tempfile.TemporaryDirectory() as temporary:
        capture(mesh, Path(temporary) / "views", views=1, size=size, test_views=views, spp=mesh_spp, seed=1)
        return photographs(field, Path(temporary) / "views", mesh, spp)


STUDIES = ("brightness", "photographs", "transmittance")


def main() -> None:
    """Measure and write the results."""
    options = record.options(
        __doc__, ("studies", {"nargs": "*", "metavar": "STUDY"}), ("--scenes", {"nargs": "+", "default": NAMES}),
        ("--photographs", {"type": Path}), ("--depth", {"type": int, "default": 2}))
    record.prepare("memory")
    start, sizes = time.perf_counter(), QUICK if options.quick else FULL
    values: dict[str, dict[str, Any]] = {}
    for name in options.studies or STUDIES:
        values[name] = {}
        for scene in options.scenes[:1] if options.quick else options.scenes:
            folder = scenes.SCENES / scene if (scenes.SCENES / scene).is_dir() else Path(scene)
            values[name][folder.name] = study(name, folder, sizes, options.photographs, options.depth)
            print(f"{time.perf_counter() - start:5.0f} s  {name} {folder.name}", flush=True)
    record.write("fields", values, start, options.out)
    print(f"load {os.getloadavg()[0]:.2f} at the end")


if __name__ == "__main__":
    main()
