"""Data sets: a set in memory (`Split`), the format of `mi-ntf capture` on disk, and the pinhole camera.

A data set of `mi-ntf capture` is a folder with one `transforms_<split>.json` for each split (train, val, test). It
follows the NeRF-synthetic/Blender convention, and each frame has its light:

    {"camera_angle_x": 0.63, "w": 128, "h": 128,                  horizontal field of view (radians), size (pixels)
     "unit_sphere": {"center": [x, y, z], "radius": r},           field = (world - center) / radius, object inside 1
     "frames": [{"file_path": "train/0000.exr",                   relative to the folder
                 "transform_matrix": [[...], ...],                4x4 camera-to-world, OpenGL: looks along -Z, +Y up
                 "pl_pos": [x, y, z],                             point light, world units
                 "pl_intensity": [r, g, b]}, ...]}                radiant intensity, W/sr, linear RGB

Images are EXR files of linear RGBA radiance with premultiplied alpha, as a renderer with a box filter writes them
(background 0). Lengths are those of the captured world. `readers` lists the other forms. This module uses NumPy alone,
so that training reads data where no renderer is installed.
"""

import hashlib
import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_ntf.core import files
from mi_ntf.data.exr import write_exr
from mi_ntf.data.images import read_image

__all__ = ["SPLITS", "Camera", "DataSet", "Frame", "Split", "Transforms", "View", "fingerprint", "focal_length",
           "mitsuba_to_opengl", "pixel_rays", "read_image", "write_exr", "write_transforms"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Frame:
    """Frame of a photograph to be written: its file, and the places of camera and light in world units."""

    file: str
    c2w: np.ndarray
    light_pos: np.ndarray
    light_intensity: np.ndarray


@dataclass(frozen=True)
class Transforms:
    """Content of one `transforms_<split>.json`: `angle_x` in radians, `center` and `radius` in world units."""

    angle_x: float
    w: int
    h: int
    center: np.ndarray
    radius: float
    frames: list[Frame]


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with a lens, in pixels; (0, 0) is the corner of the top left pixel."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty: a straight picture


@dataclass(frozen=True)
class View:
    """Photograph as a data set describes it, before its pixels are read. None means that the data set does not say."""

    where: str  # file and frame, for messages
    image: Path
    name: str  # the photograph's file as the data set calls it; its mask has the same name
    masks: list[Path]  # possible places of the mask
    c2w: np.ndarray  # (4, 4) camera-to-world, OpenGL axes
    camera: Camera | float  # a number is the horizontal field of view in radians of a centred camera
    size: tuple[int, int] | None = None  # (width, height) in pixels
    light_pos: np.ndarray | None = None
    light_intensity: np.ndarray | None = None
    mask_first: bool = False  # the mask replaces the image's own alpha
    rescaled: bool = False  # the photograph may have another size than `size`, which is that of `camera`
    orientation: int = 1  # the file's Exif orientation, 1 to 8
    upright: bool = False  # pose and camera are those of the photograph turned by `orientation`
    mask_upright: bool = False  # the mask is that of the photograph turned by `orientation`


@dataclass(frozen=True)
class DataSet:
    """Data set as its files describe it, before any pixel is read, in world units."""

    form: str  # name of the form, for messages
    views: dict[str, list[View]]  # by split
    sphere: tuple[np.ndarray, float] | None = None  # center (3,) and radius of the object's sphere
    points: np.ndarray | None = None  # (P, 3) reconstructed points
    notes: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)  # assumptions about ambiguous files, a sentence each


@dataclass(frozen=True)
class Split:
    """Split in memory: N frames of H x W pixels, float32 unless noted, and the similarity that all splits share."""

    images: np.ndarray  # (N, H, W, 4) RGBA as stored: 8-bit levels, float16 or float32; `images.linear` makes it linear
    c2w: np.ndarray  # (N, 4, 4) float64, OpenGL axes
    focal: np.ndarray  # (N, 2) fx and fy in pixels, float64
    principal: np.ndarray  # (N, 2) cx and cy in pixels from the top left corner, float64
    light_pos: np.ndarray  # (N, 3) world units, float64
    light_intensity: np.ndarray  # (N, 3) W/sr
    center: np.ndarray  # (3,); field = (world - center) / radius
    radius: float
    names: tuple[str, ...] = ()  # the photographs' files, for messages
    masked: bool = True
    """True: alpha is the object's fraction of the pixel. False: the background is black, and alpha is 1 for matter, 0
    for empty space, and between them where neither is known."""
    calibrated: bool = True  # the lights' intensities come from the data set; else one estimate serves all photographs
    located: bool = True  # the lights' places come from the data set; else they are the lenses'


def drop_missing(splits: dict[str, list[View]]) -> tuple[dict[str, list[View]], list[str]]:
    """Return the splits without the views that have no photograph, and a note on them.

    If most photographs are missing, it is the wrong folder or an incomplete copy: then all views stay, and reading them
    raises the error.
    """
    complete = {split: [view for view in views if view.image.is_file()] for split, views in splits.items()}
    count, existing = (sum(map(len, each.values())) for each in (splits, complete))
    if existing == count or existing <= count / 2 or not complete["train"]:
        return splits, []
    return ({split: views for split, views in complete.items() if views},
            [f"{count - existing} of {count} frames have no photograph and are left out"])


def write_transforms(folder: Path, split: str, transforms: Transforms) -> Path:
    """Write `transforms_<split>.json` (whole or not at all) and return its path."""
    data = {
        "camera_angle_x": transforms.angle_x, "w": transforms.w, "h": transforms.h,
        "unit_sphere": {"center": transforms.center.tolist(), "radius": transforms.radius},
        "frames": [{"file_path": f.file, "transform_matrix": f.c2w.tolist(), "pl_pos": f.light_pos.tolist(),
                    "pl_intensity": f.light_intensity.tolist()} for f in transforms.frames],
    }
    path = Path(folder) / f"transforms_{split}.json"
    files.write(path, json.dumps(data, indent=1) + "\n")
    return path


def fingerprint(splits: dict[str, Split]) -> dict[str, str]:
    """Return hashes of the content of `splits` by its kind, independent of the files that it comes from."""
    parts = {"photographs or masks": ("images", "masked"), "cameras": ("c2w", "focal", "principal"),
             "lights": ("light_pos", "light_intensity"), "the object's sphere": ("center", "radius")}
    hashes = {}
    for kind, names in parts.items():
        digest = hashlib.sha256()
        for split, name in itertools.product(sorted(splits), names):
            value = np.ascontiguousarray(getattr(splits[split], name))
            digest.update(f"{split} {name} {value.dtype} {value.shape}".encode())
            digest.update(value.data)
        hashes[kind] = digest.hexdigest()
    return hashes


def focal_length(angle_x: float, w: float) -> float:
    """Return the focal length in pixels of a camera `w` pixels wide with horizontal field of view `angle_x` (rad)."""
    return float(0.5 * w / np.tan(0.5 * angle_x))


def pixel_rays(c2w: np.ndarray, focal: "float | np.ndarray", w: int, h: int, principal: np.ndarray | None = None
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return the rays through the pixel centres: origins and unit directions, both (..., h, w, 3), in world axes.

    `c2w` (..., 4, 4) are OpenGL camera-to-world matrices. `focal` is in pixels, one number or (..., 2) for x and y. The
    `principal` point (..., 2) is in pixels from the top left corner; the default is the middle of the image. Row 0 is
    the top row, column 0 the left one. Source: the pinhole model of NeRF's `get_rays`.
    """
    focal = np.asarray(focal, dtype=np.float64)
    focal = np.stack([focal, focal], -1) if focal.ndim == 0 else focal
    principal = np.array([0.5 * w, 0.5 * h]) if principal is None else np.asarray(principal, dtype=np.float64)
    y, x = np.meshgrid(np.arange(h) + 0.5, np.arange(w) + 0.5, indexing="ij")
    plane = (np.stack([x, y], -1) - principal[..., None, None, :]) / focal[..., None, None, :]
    local = np.concatenate([plane * (1.0, -1.0), -np.ones_like(plane[..., :1])], -1)
    directions = np.einsum("...ij,...hwj->...hwi", c2w[..., :3, :3], local)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.broadcast_to(c2w[..., None, None, :3, 3], directions.shape), directions


def mitsuba_to_opengl(to_world: np.ndarray) -> np.ndarray:
    """Return the OpenGL camera-to-world (..., 4, 4) of a Mitsuba sensor's `to_world` (+X left, looks along +Z).

    The function flips the camera's X and Z axes, and it is its own inverse.
    """
    flipped: np.ndarray = np.asarray(to_world, dtype=np.float64) * np.array([-1.0, 1.0, -1.0, 1.0])
    return flipped
