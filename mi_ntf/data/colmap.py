"""Reader of COLMAP models, text or binary, through pycolmap. Photographs with a flash at the lens.

Accepted folders: `DIR/images` with the model in `DIR/sparse/0`, `DIR/sparse` or `DIR`; DIR may be the model's own
folder with `images` in it or up to two levels above. Masks in `masks` beside `images`.
"""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import mask_places
from mi_ntf.data.schema import Found, View

PINHOLE = {"SIMPLE_PINHOLE": (0, 0, 1, 2), "PINHOLE": (0, 1, 2, 3)}
"""Where fx, fy, cx, cy stand in a camera's parameters."""


def find_model(folder: Path) -> Path | None:
    """The folder that holds `cameras` and `images`, as .bin or .txt, or None."""
    for place in (folder / "sparse" / "0", folder / "sparse", folder):
        if any((place / f"cameras{s}").is_file() and (place / f"images{s}").is_file() for s in (".bin", ".txt")):
            return place
    return None


def read(folder: Path, model: Path) -> Found:
    """All posed photographs of the model as one split, `train`, by name, and its points. Raises MiNtfError."""
    reconstruction = _open(model)
    root = next((p for p in (folder, folder.parent, folder.parent.parent) if (p / "images").is_dir()), None)
    if root is None:
        raise MiNtfError(f"{folder / 'images'} does not exist; put the photographs of the model {model} there")
    views = []
    for image in sorted(map(reconstruction.image, reconstruction.reg_image_ids()), key=lambda i: i.name):
        where = f"{model}, image '{image.name}'"
        camera = _camera(reconstruction.camera(image.camera_id), f"{model}, camera {image.camera_id}")
        size = reconstruction.camera(image.camera_id)
        views.append(View(where, root / "images" / image.name, mask_places(root, image.name),
                          _opengl(np.array(image.cam_from_world().matrix()), where), camera,
                          (int(size.width), int(size.height))))
    if not views:
        raise MiNtfError(f"{model}: the model has no posed photograph; run `colmap mapper` again")
    points = np.array([p.xyz for p in reconstruction.points3D.values()]).reshape(-1, 3)
    stored = sum(f.suffix.lower() in (".png", ".exr", ".jpg", ".jpeg") for f in (root / "images").rglob("*"))
    notes = [f"{stored - len(views)} of {stored} photographs in {root / 'images'} have no pose and are left out"]
    return Found({"train": views}, None, points, notes if stored > len(views) else [])


def _open(model: Path):
    """The reconstruction. pycolmap looks for binary files before text ones."""
    try:
        import pycolmap
    except ImportError as error:
        raise MiNtfError(f"{model} is a COLMAP model; reading it needs pycolmap ({error}): "
                         "pip install 'mi-ntf[colmap]'") from error
    try:
        return pycolmap.Reconstruction(str(model))
    except Exception as error:  # pycolmap raises many kinds for a damaged file
        raise MiNtfError(f"{model}: cannot be read as a COLMAP model ({' '.join(str(error).split())[:200]}); it needs "
                         "cameras, images and points3D, all .bin or all .txt: export it again with "
                         "`colmap model_converter`") from error


def _camera(camera, where: str) -> tuple[float, float, float, float]:
    name = camera.model_name if hasattr(camera, "model_name") else camera.model.name
    if name not in PINHOLE:
        raise MiNtfError(f"{where}: its model {name} has lens distortion; rays are straight here: run `colmap "
                         "image_undistorter` and train on its output folder (PINHOLE)")
    fx, fy, cx, cy = (float(camera.params[i]) for i in PINHOLE[name])
    return fx, fy, cx, cy


def _opengl(w2c: np.ndarray, where: str) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) of COLMAP's world-to-camera (3, 4) with OpenCV axes (x right, y down, z ahead)."""
    if not np.isfinite(w2c).all():
        raise MiNtfError(f"{where}: its pose is not finite: {w2c.tolist()}; run `colmap mapper` again")
    c2w = np.eye(4)
    c2w[:3, :3] = w2c[:, :3].T * (1.0, -1.0, -1.0)
    c2w[:3, 3] = -w2c[:, :3].T @ w2c[:, 3]
    return c2w
