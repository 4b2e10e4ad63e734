"""Data sets: what is in memory (`Split`), our own format on disk, and the pinhole camera.

A data set of `mi-ntf capture` is a folder with one `transforms_<split>.json` a split (train, val, test), in the
NeRF-synthetic/Blender convention, and per frame the light that took part:

    {"camera_angle_x": 0.63, "w": 128, "h": 128,                  horizontal field of view (radians), size (pixels)
     "unit_sphere": {"center": [x, y, z], "radius": r},           field = (world - center) / radius, object inside 1
     "frames": [{"file_path": "train/0000.exr",                   relative to the folder
                 "transform_matrix": [[...], ...],                4x4 camera-to-world, OpenGL: looks along -Z, +Y up
                 "pl_pos": [x, y, z],                             point light, world units
                 "pl_intensity": [r, g, b]}, ...]}                radiant intensity, W/sr, linear RGB

Images are linear RGBA radiance with alpha premultiplied, as a renderer with a box filter writes them (background 0), in
EXR. Lengths are those of the captured world. What else is read, and how: `readers`. NumPy only: training reads data
where no renderer is installed.
"""

import hashlib
import itertools
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_ntf.core import files
from mi_ntf.data.images import read_image, write_exr

__all__ = ["SPLITS", "Camera", "Found", "Frame", "Split", "Transforms", "View", "fingerprint", "focal_length",
           "mitsuba_to_opengl", "pixel_rays", "read_image", "write_exr", "write_transforms"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Frame:
    """Frame of a photograph to be written: its file, and the places of camera and light (world units)."""

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
    """A pinhole, and the lens before it. Pixels; (0, 0) is the corner of the top left pixel."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; none: straight."""


@dataclass(frozen=True)
class View:
    """Photograph as a reader found it, pixels not yet read. `None`: the data set does not say."""

    where: str
    """File and frame, for messages."""
    image: Path
    name: str
    """The photograph's file as the data set calls it: by that its mask is found."""
    masks: list[Path]
    """Where its mask may lie."""
    c2w: np.ndarray
    """(4, 4) camera-to-world, OpenGL axes."""
    camera: Camera | float
    """A number: the horizontal field of view in radians, of square pixels and a centred camera."""
    size: tuple[int, int] | None = None
    """(width, height) in pixels."""
    light_pos: np.ndarray | None = None
    light_intensity: np.ndarray | None = None
    mask_first: bool = False
    """The mask is the alpha, whatever the image has."""
    rescaled: bool = False
    """The photograph may be a copy of another size than `size`; `camera` is that of `size`."""
    orientation: int = 1
    """The file's Exif orientation, 1 to 8."""
    upright: bool = False
    """Pose and camera are those of the photograph turned by `orientation`."""
    mask_upright: bool = False
    """The mask is that of the photograph turned by `orientation`."""


@dataclass(frozen=True)
class Found:
    """Data set that a reader found in a folder, pixels not yet read. World units; `sphere` is (center (3,), radius)."""

    form: str
    """What the data set is and where it lies, for messages."""
    views: dict[str, list[View]]
    sphere: tuple[np.ndarray, float] | None = None
    points: np.ndarray | None = None
    """(P, 3) reconstructed points."""
    notes: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    """What was assumed where the data set could mean something else, a sentence each."""


@dataclass(frozen=True)
class Split:
    """A split in memory. N frames of H x W pixels; float32 unless noted.

    images (N, H, W, 4) RGBA as they are stored, which :func:`mi_ntf.data.images.linear` makes linear premultiplied
    float32: 8-bit levels, or float16 or float32 · c2w (N, 4, 4) float64, OpenGL axes · focal (N, 2) fx, fy and
    principal (N, 2) cx, cy in pixels from the top left corner, float64 · light_pos (N, 3) world ·
    light_intensity (N, 3) · center (3,) and radius: field = (world - center) / radius.
    """

    images: np.ndarray
    c2w: np.ndarray
    focal: np.ndarray
    principal: np.ndarray
    light_pos: np.ndarray
    light_intensity: np.ndarray
    center: np.ndarray
    radius: float
    names: tuple[str, ...] = ()
    """The photographs' files, for messages."""
    masked: bool = True
    """Alpha is the object's share of the pixel; if not, the background is black, and alpha says what is known: 1
    matter, 0 none, all between unknown."""
    calibrated: bool = True
    """The lights' intensities were given; if not, they are estimated, alike for all photographs."""
    located: bool = True
    """The lights' places were given; if not, they are the lenses'."""


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
    """Hashes of all that `splits` hold, by what it is: tells changed data from the same ones, in whatever files."""
    parts = {"photographs or masks": ("images", "masked"), "cameras": ("c2w", "focal", "principal"),
             "lights": ("light_pos", "light_intensity"), "the object's sphere": ("center", "radius")}
    found = {}
    for what, names in parts.items():
        digest = hashlib.sha256()
        for split, name in itertools.product(sorted(splits), names):
            value = np.ascontiguousarray(getattr(splits[split], name))
            digest.update(f"{split} {name} {value.dtype} {value.shape}".encode())
            digest.update(value.data)
        found[what] = digest.hexdigest()
    return found


def focal_length(angle_x: float, w: float) -> float:
    """Focal length in pixels of a camera `w` pixels wide with horizontal field of view `angle_x` (radians)."""
    return float(0.5 * w / np.tan(0.5 * angle_x))


def pixel_rays(c2w: np.ndarray, focal, w: int, h: int, principal=None) -> tuple[np.ndarray, np.ndarray]:
    """Rays through the pixel centres: origins and unit directions, both (..., h, w, 3), world.

    c2w (..., 4, 4) OpenGL camera-to-world; focal in pixels, one number or (..., 2) for x and y; principal point
    (..., 2) in pixels from the top left corner, the middle of the image unless given. Row 0 is the top row, column 0
    the left one. Source: the pinhole model of NeRF's `get_rays`.
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
    """OpenGL camera-to-world (+X right, looks down -Z) of a Mitsuba sensor's `to_world` (+X left, looks along +Z).

    Flips the camera's X and Z axes, (..., 4, 4) -> (..., 4, 4); the flip is its own inverse, so it also leads back.
    """
    return np.asarray(to_world, dtype=np.float64) * np.array([-1.0, 1.0, -1.0, 1.0])
