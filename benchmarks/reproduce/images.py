"""One picture of one scene, light and method, and its measures against the path-traced meshes."""

import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import errors, files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.schema import write_exr
from mi_ntf.evaluate import compare, metrics, perceptual

from ..photographs import field_ball
from .compared import METRICS, Method, Scene, Sizes, ball
from .lights import DISTANCE, Light

DEPTH = 6
"""Edges of a path, on both sides: the meshes scatter light more than once, and so does the field (radiosity)."""
PATHS = 1 << 23
"""Of the meshes, traced at once."""


class Studio:
    """What the pictures of a scene have in common: meshes, camera, fields and the patches of their skins."""

    def __init__(self, scene: Scene, sizes: Sizes):
        self.scene, self.sizes = scene, sizes
        loaded = meshes(scene, sizes.pixels)
        self._meshes = {f"shape{i}": s for i, s in enumerate(loaded.shapes()) if not s.is_emitter()}
        self._sensor = loaded.sensors()[0]
        self._balls: dict[Path, Any] = {}
        self._patches: dict[Path, Any] = {}
        self.centre, self.radius = ball(scene)

    @property
    def eye(self) -> np.ndarray:
        """The place of the scene's camera, (3,), scene units."""
        return np.array(self._sensor.world_transform().translation()).ravel()

    def reference(self, light: Light, seed: int) -> np.ndarray:
        """The path-traced meshes, linear RGBA (h, w, 4)."""
        scene = mi.load_dict({"type": "scene", "light": light.emitter, **self._meshes})
        integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "hide_emitters": True})
        pixels, spp = self.sizes.pixels**2, self.sizes.reference_spp
        passes = -(-pixels * spp // PATHS)
        total: Any = 0
        for k in range(passes):
            number: Any = 1000 * (seed + 1) + k  # a number, where Mitsuba's stub asks for an array
            image = mi.render(scene, sensor=self.sensor(light), integrator=integrator, spp=-(-spp // passes),
                              seed=number)
            total = total + np.array(image, np.float64)
        return (total / passes).astype(np.float32)

    def image(self, light: Light, method: Method, field: Path, seed: int) -> tuple[np.ndarray, float]:
        """The `field` lit by `method`, linear RGBA (h, w, 4), and the seconds that it took, maps and volumes
        included."""
        if field not in self._balls:
            self._balls[field] = mi.load_dict(field_ball(field))
        scene = mi.load_dict({"type": "scene", "light": light.emitter, "ball": self._balls[field]})
        sizes = self.sizes
        integrator: Any = mi.load_dict({
            "type": "nrf", "visibility": method.visibility, "max_depth": DEPTH, "hide_emitters": True,
            "environment_lights": sizes.cells, "map_resolution": sizes.map_resolution, **method.options})
        integrator.patches = self._patches.get(field)  # they are the field's, whatever the light
        spp = sizes.spp[light.kind == "environment"]
        number: Any = seed
        start = time.perf_counter()
        image = np.array(mi.render(scene, sensor=self.sensor(light), integrator=integrator, spp=spp, seed=number))
        seconds = time.perf_counter() - start
        self._patches[field] = integrator.patches
        dr.flush_malloc_cache()  # volumes are gigabytes
        return image, seconds

    def sensor(self, light: Light):
        """The scene's camera, or one that stands where the light's camera does and sees the whole sphere."""
        if light.camera is None:
            return self._sensor
        side = self.sizes.pixels
        up = [0.0, 1.0, 0.0]
        along = np.subtract(light.camera, self.centre)
        if abs(along[1]) > 0.99 * np.linalg.norm(along):
            up = [0.0, 0.0, 1.0]
        look: Any = mi.ScalarTransform4f().look_at(origin=list(light.camera), target=list(self.centre), up=up)
        film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}, "pixel_format": "rgba",
                "component_format": "float32"}
        fov = float(2 * np.degrees(np.arcsin(1 / DISTANCE)))
        return mi.load_dict({"type": "perspective", "fov": fov, "to_world": look, "film": film,
                             "sampler": {"type": "independent"}})


def meshes(scene: Scene, pixels: int):
    """The Mitsuba scene of the meshes, of `pixels`² pixels. Raises MiNtfError."""
    try:
        loaded = mi.load_file(str(scene.mesh), res=str(pixels))
    except RuntimeError as error:
        raise MiNtfError(f"{scene.mesh} cannot be loaded ({errors.sentence(error)}); as in shipped scenes, "
                         "$res must be its film's size") from None
    if not loaded.sensors():
        raise MiNtfError(f"{scene.mesh} has no sensor; add the one that its pictures are seen by")
    return loaded


def measure(image: np.ndarray, reference: np.ndarray) -> dict[str, float | None]:
    """The metrics of table 2 of linear RGBA pictures on black; None for what picture or machine do not allow."""
    found: dict[str, float | None] = {}
    for name in METRICS:
        try:
            metric = getattr(perceptual if name == "lpips" else metrics, name)
            found[name] = metric(image[..., :3], reference[..., :3])
        except metrics.NotMeasured:
            found[name] = None
    return found


def reference_file(out: Path, scene: Scene, light: Light) -> Path:
    return out / "references" / scene.name / f"{light.name}.exr"


def picture_file(out: Path, scene: Scene, light: Light, method: Method) -> Path:
    return out / "pictures" / scene.name / f"{light.name}_{method.name}.exr"


def save(path: Path, image: np.ndarray) -> None:
    """Write an EXR; its folders are made."""
    files.make_folder(path.parent)
    write_exr(path, image)


def load(path: Path) -> np.ndarray:
    """Linear RGBA. Raises MiNtfError."""
    return compare.read_image(path)
