"""Reader of COLMAP models, text or binary.

Accepted folders: `DIR/images` with the model in `DIR/sparse/0`, `DIR/sparse` or `DIR`, or in `DIR/colmap` in place of
`DIR`; of several models the one with most images is read. DIR may be the model's own folder with `images` in it or up
to three levels above. Masks in `masks` beside `images`. Cameras with lens distortion are undone (`lens`), those of
fisheyes are not read.

Source of the camera models: COLMAP's documentation, "Camera Models", and `src/colmap/sensor/models.h`.
"""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import colmap_files
from mi_ntf.data.file_names import SUFFIXES, locate, mask_places, plain
from mi_ntf.data.schema import Camera, Found, View

FORM = "COLMAP model"
PARAMETERS = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2), "PINHOLE": (0, 1, 2, 3), "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4), "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7), "FULL_OPENCV": tuple(range(12)),
}
"""Where fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3 to k6 stand among a camera's parameters."""


def models(folder: Path) -> list[Path]:
    """The folders that hold `cameras` and `images`, as .bin or .txt."""
    places = []
    for sparse in (folder / "sparse", folder / "colmap" / "sparse"):
        numbered = [place for place in sparse.iterdir() if place.is_dir()] if sparse.is_dir() else []
        places += [*sorted(numbered, key=lambda place: (len(place.name), place.name)), sparse]
    return [place for place in (*places, folder) if colmap_files.suffix(place)]


def _largest(folder: Path) -> tuple[Path, list[str]]:
    """``(model, what was assumed)``: the folder's model that has most images, of equal ones the first."""
    found = models(folder)
    if len(found) == 1:
        return found[0], []
    counts = [colmap_files.count(model) for model in found]
    told = ", ".join(f"{model.relative_to(folder)} with {count}" for model, count in zip(found, counts, strict=True))
    model = found[counts.index(max(counts))]
    return model, [f"of {len(found)} COLMAP models the one with most photographs is read, {model} ({told}); name a "
                   "model's own folder to read another"]


def read(folder: Path) -> Found:
    """Read all posed photographs of the folder's model as one split, `train`, by name, and its points. Raises
    MiNtfError."""
    model, assumed = _largest(folder)
    cameras, images, points, noted = colmap_files.read(model)
    root = next((p for p in (folder, folder / "colmap", *list(folder.absolute().parents)[:3]) if (p / "images").is_dir()
                 ), None)
    if root is None:
        raise MiNtfError(f"{folder / 'images'} does not exist; put the photographs of the model {model} there")
    views = []
    for image in sorted(images, key=lambda i: i.name):
        where = f"{model}, image '{image.name}'"
        if image.camera not in cameras:
            raise MiNtfError(f"{where}: there is no camera {image.camera}; export the model again with `colmap "
                             "model_converter`")
        camera = cameras[image.camera]
        name = plain(image.name)
        views.append(View(where, locate(root / "images", image.name), name, mask_places(root / "masks", name),
                          _opengl(image), _camera(camera, f"{model}, camera {image.camera}"),
                          (camera.width, camera.height)))
    if not views:
        raise MiNtfError(f"{model}: the model has no posed photograph; run `colmap mapper` again")
    stored = sum(f.suffix.lower() in SUFFIXES for f in (root / "images").rglob("*"))
    notes = [f"{stored - len(views)} of {stored} photographs in {root / 'images'} have no pose and are left out"]
    assumed += noted + ([f"{model} has no points3D, so points tell nothing of the object's place"] if points is None
                        else [])
    return Found(FORM, {"train": views}, None, points, notes if stored > len(views) else [], assumed)


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
