"""Reader of COLMAP models, text or binary.

Accepted folders: `DIR/images` with the model in `DIR/sparse/0`, `DIR/sparse` or `DIR`; DIR may be the model's own
folder with `images` in it or up to two levels above. Masks in `masks` beside `images`. Cameras with lens distortion are
undone (`lens`), those of fisheyes are not read.

Source of the camera models: COLMAP's documentation, "Camera Models", and `src/colmap/sensor/models.h`.
"""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import colmap_files
from mi_ntf.data.images import SUFFIXES, mask_places
from mi_ntf.data.schema import Camera, Found, View

FORM = "COLMAP model"
PARAMETERS = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2), "PINHOLE": (0, 1, 2, 3), "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4), "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7), "FULL_OPENCV": tuple(range(12)),
}
"""Where fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3 to k6 stand among a camera's parameters."""


def find_model(folder: Path) -> Path | None:
    """The folder that holds `cameras` and `images`, as .bin or .txt, or None."""
    for place in (folder / "sparse" / "0", folder / "sparse", folder):
        if any((place / f"cameras{s}").is_file() and (place / f"images{s}").is_file() for s in (".bin", ".txt")):
            return place
    return None


def read(folder: Path) -> Found:
    """All posed photographs of the folder's model as one split, `train`, by name, and its points. Raises MiNtfError."""
    model = find_model(folder)
    assert model is not None  # what makes it a folder of this form
    cameras, images, points = colmap_files.read(model)
    root = next((p for p in (folder, folder.parent, folder.parent.parent) if (p / "images").is_dir()), None)
    if root is None:
        raise MiNtfError(f"{folder / 'images'} does not exist; put the photographs of the model {model} there")
    views = []
    for image in sorted(images, key=lambda i: i.name):
        where = f"{model}, image '{image.name}'"
        if image.camera not in cameras:
            raise MiNtfError(f"{where}: there is no camera {image.camera}; export the model again with `colmap "
                             "model_converter`")
        camera = cameras[image.camera]
        views.append(View(where, root / "images" / image.name, image.name, mask_places(root / "masks", image.name),
                          _opengl(image), _camera(camera, f"{model}, camera {image.camera}"),
                          (camera.width, camera.height)))
    if not views:
        raise MiNtfError(f"{model}: the model has no posed photograph; run `colmap mapper` again")
    stored = sum(f.suffix.lower() in SUFFIXES for f in (root / "images").rglob("*"))
    notes = [f"{stored - len(views)} of {stored} photographs in {root / 'images'} have no pose and are left out"]
    return Found(FORM, {"train": views}, None, points, notes if stored > len(views) else [])


def _camera(camera: colmap_files.Camera, where: str) -> Camera:
    """The camera as OpenCV has it; COLMAP's pixels begin at the corner, as ours do."""
    if camera.model not in PARAMETERS:
        raise MiNtfError(f"{where}: its model {camera.model} is not read ({', '.join(PARAMETERS)} are); run `colmap "
                         "image_undistorter` and train on its output folder (PINHOLE)")
    fx, fy, cx, cy, *bent = (camera.params[i] for i in PARAMETERS[camera.model])
    if min(fx, fy) <= 0:
        raise MiNtfError(f"{where}: its focal length is {min(fx, fy):g}, must be positive; run `colmap mapper` again")
    bent += [0.0] * (4 - len(bent))
    return Camera(fx, fy, cx, cy, tuple(bent) if any(bent) else ())


def _opengl(image: colmap_files.Image) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) of COLMAP's world-to-camera with OpenCV axes (x right, y down, z ahead)."""
    w, x, y, z = np.array(image.quaternion) / np.linalg.norm(image.quaternion)
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T * (1.0, -1.0, -1.0)
    c2w[:3, 3] = -rotation.T @ image.translation
    return c2w
