"""The data set: a folder of photographs with one `transforms_<split>.json` a split (train, val, test).

The NeRF-synthetic/Blender convention, and per frame the light that took part:

    {"camera_angle_x": 0.63, "w": 128, "h": 128,                  horizontal field of view (radians), size (pixels)
     "unit_sphere": {"center": [x, y, z], "radius": r},           field = (world - center) / radius, object inside 1
     "frames": [{"file_path": "train/0000.exr",                   relative to the folder
                 "transform_matrix": [[...], ...],                4x4 camera-to-world, OpenGL: looks along -Z, +Y up
                 "pl_pos": [x, y, z],                             point light, world units
                 "pl_intensity": [r, g, b]}, ...]}                radiant intensity, W/sr, linear RGB

Images are linear RGBA radiance with alpha premultiplied, as a renderer with a box filter writes them (background 0), in
EXR. PNG (8 bit, sRGB, straight alpha) is read too and turned into the same. Lengths are those of the captured world.
NumPy only: training reads this file where no renderer is installed.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Frame:
    """One photograph: where the file is and where camera and light were (world units)."""

    file: str
    c2w: np.ndarray
    light_pos: np.ndarray
    light_intensity: np.ndarray


@dataclass(frozen=True)
class Transforms:
    """What one `transforms_<split>.json` says; `angle_x` in radians, `center` and `radius` in world units."""

    angle_x: float
    w: int
    h: int
    center: np.ndarray
    radius: float
    frames: list[Frame]


@dataclass(frozen=True)
class Split:
    """A split in memory. N frames of H x W pixels; float32 unless noted.

    images (N, H, W, 4) linear premultiplied RGBA · c2w (N, 4, 4) float64, OpenGL axes · focal in pixels ·
    light_pos (N, 3) world · light_intensity (N, 3) · center (3,) and radius: field = (world - center) / radius.
    """

    images: np.ndarray
    c2w: np.ndarray
    focal: float
    light_pos: np.ndarray
    light_intensity: np.ndarray
    center: np.ndarray
    radius: float


def _numbers(entry: dict, key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """The finite float array `entry[key]` of `shape` (float64), or a MiNtfError that begins with `where`."""
    if key not in entry:
        raise MiNtfError(f"{where}: '{key}' is missing; see mi_ntf/data/schema.py for the format")
    try:
        value = np.array(entry[key], dtype=np.float64)
    except (TypeError, ValueError):
        raise MiNtfError(f"{where}: '{key}' is {entry[key]!r}, expected numbers of shape {shape}") from None
    if value.shape != shape:
        raise MiNtfError(f"{where}: '{key}' has shape {value.shape}, expected {shape}; write it as nested lists")
    if not np.isfinite(value).all():
        raise MiNtfError(f"{where}: '{key}' is not finite: {value.tolist()}; correct the pose or light")
    return value


def _positive(entry: dict, key: str, where: str) -> float:
    value = float(_numbers(entry, key, (), where))
    if value <= 0.0:
        raise MiNtfError(f"{where}: '{key}' is {value:g}, must be positive")
    return value


def _frame(entry: dict, where: str) -> Frame:
    if "file_path" not in entry:
        raise MiNtfError(f"{where}: 'file_path' is missing; name the image relative to the folder")
    c2w = _numbers(entry, "transform_matrix", (4, 4), where)
    error = np.abs(c2w[:3, :3].T @ c2w[:3, :3] - np.eye(3)).max()
    if error > 1e-3 or np.linalg.det(c2w[:3, :3]) < 0 or np.abs(c2w[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise MiNtfError(f"{where}: 'transform_matrix' is no rigid motion (rotation off by {error:.2g}, determinant "
                         f"{np.linalg.det(c2w[:3, :3]):.3g}); remove scale and mirroring, keep the last row 0 0 0 1")
    if "pl_pos" not in entry or "pl_intensity" not in entry:
        raise MiNtfError(f"{where}: 'pl_pos' or 'pl_intensity' is missing; training needs photographs taken with a "
                         "known point light (for a flash on the camera: pl_pos = the camera's position)")
    light = [_numbers(entry, key, (3,), where) for key in ("pl_pos", "pl_intensity")]
    return Frame(str(entry["file_path"]), c2w, *light)


def read_transforms(folder: Path, split: str) -> Transforms:
    """Read and check `transforms_<split>.json`. Raises MiNtfError."""
    path = Path(folder) / f"transforms_{split}.json"
    if split not in SPLITS:
        raise MiNtfError(f"split '{split}' is unknown; it is one of {', '.join(SPLITS)}")
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; make a data set with `mi-ntf capture SCENE.xml {folder}`")
    try:
        data = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise MiNtfError(f"{path}: not valid JSON ({error}); the file is damaged, capture it again") from None
    if not data.get("frames"):
        raise MiNtfError(f"{path}: 'frames' is empty or missing; a split needs one photograph at least")
    frames = [_frame(entry, f"{path}, frame {i}") for i, entry in enumerate(data["frames"])]
    angle = _positive(data, "camera_angle_x", str(path))
    if angle >= np.pi:
        raise MiNtfError(f"{path}: 'camera_angle_x' is {angle:g}, must be below pi; it is in radians")
    sphere, where = data.get("unit_sphere", {}), f"{path}, unit_sphere"
    return Transforms(angle, int(_positive(data, "w", str(path))), int(_positive(data, "h", str(path))),
                      _numbers(sphere, "center", (3,), where), _positive(sphere, "radius", where), frames)


def write_transforms(folder: Path, split: str, transforms: Transforms) -> Path:
    """Write `transforms_<split>.json` (through a temporary name) and return its path."""
    data = {
        "camera_angle_x": transforms.angle_x, "w": transforms.w, "h": transforms.h,
        "unit_sphere": {"center": transforms.center.tolist(), "radius": transforms.radius},
        "frames": [{"file_path": f.file, "transform_matrix": f.c2w.tolist(), "pl_pos": f.light_pos.tolist(),
                    "pl_intensity": f.light_intensity.tolist()} for f in transforms.frames],
    }
    path = Path(folder) / f"transforms_{split}.json"
    temporary = path.with_suffix(".json.tmp")
    temporary.write_text(json.dumps(data, indent=1) + "\n")
    os.replace(temporary, path)
    return path


def read_image(path: Path) -> np.ndarray:
    """Linear premultiplied RGBA (H, W, 4) float32 of an EXR (RGB or RGBA) or an 8-bit PNG (sRGB, straight alpha).

    Raises MiNtfError where the file is missing, unreadable, of another kind, or holds NaN or infinity.
    """
    path = Path(path)
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; the data set is incomplete, run the capture again (it resumes)")
    reader = {".exr": _read_exr, ".png": _read_png}.get(path.suffix.lower())
    if reader is None:
        raise MiNtfError(f"{path}: images of type '{path.suffix}' are not read; convert it to .exr or .png")
    try:
        pixels = reader(path)
    except MiNtfError:
        raise
    except Exception as error:  # OpenEXR and Pillow raise many kinds for a damaged file
        raise MiNtfError(f"{path}: cannot be read as an image ({error}); delete it and capture it again") from error
    bad = int(np.count_nonzero(~np.isfinite(pixels).all(-1)))
    if bad:
        raise MiNtfError(f"{path}: {bad} pixels are NaN or infinite; delete it and capture it again")
    return pixels


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(c.pixels, dtype=np.float32) for name, c in file.channels().items()}
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise MiNtfError(f"{path}: has channels {', '.join(sorted(channels))}, lacks {', '.join(missing)}; "
                         "write it as RGB or RGBA")
    alpha = channels.get("A", np.ones_like(channels["R"]))
    return np.stack([channels["R"], channels["G"], channels["B"], alpha], -1)


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as image:
        if image.mode not in ("L", "LA", "P", "RGB", "RGBA"):
            raise MiNtfError(f"{path}: PNG of mode '{image.mode}'; write it with 8 bits a channel, or as EXR")
        srgb = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255.0
    rgb, alpha = srgb[..., :3], srgb[..., 3:]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return np.concatenate([linear * alpha, alpha], -1).astype(np.float32)


def write_exr(path: Path, rgba: np.ndarray) -> None:
    """Write linear premultiplied RGBA (H, W, 4) as a half-float EXR, through a temporary name in the same folder."""
    import OpenEXR

    temporary = path.with_suffix(".tmp.exr")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGBA": np.ascontiguousarray(rgba, dtype=np.float16)}) as file:
        file.write(str(temporary))
    os.replace(temporary, path)


def load_split(folder: Path, split: str) -> Split:
    """Load one split of a data set with all its images. Raises MiNtfError."""
    transforms = read_transforms(folder, split)
    images = np.empty((len(transforms.frames), transforms.h, transforms.w, 4), np.float32)
    for i, frame in enumerate(transforms.frames):
        pixels = read_image(Path(folder) / frame.file)
        if pixels.shape[:2] != images.shape[1:3]:
            raise MiNtfError(f"{Path(folder) / frame.file}: is {pixels.shape[1]}x{pixels.shape[0]}, "
                             f"transforms_{split}.json says {transforms.w}x{transforms.h}; all images of a split "
                             "have the size 'w' x 'h'")
        images[i] = pixels
    return Split(
        images=images,
        c2w=np.stack([f.c2w for f in transforms.frames]),
        focal=focal_length(transforms.angle_x, transforms.w),
        light_pos=np.stack([f.light_pos for f in transforms.frames]).astype(np.float32),
        light_intensity=np.stack([f.light_intensity for f in transforms.frames]).astype(np.float32),
        center=transforms.center,
        radius=transforms.radius,
    )


def focal_length(angle_x: float, w: int) -> float:
    """Focal length in pixels of a camera `w` pixels wide with horizontal field of view `angle_x` (radians)."""
    return float(0.5 * w / np.tan(0.5 * angle_x))


def pixel_rays(c2w: np.ndarray, focal: float, w: int, h: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays through the pixel centres: origins and unit directions, both (..., h, w, 3), world.

    c2w (..., 4, 4) OpenGL camera-to-world; focal in pixels. Row 0 is the top row, column 0 the left one; the principal
    point is the middle of the image and pixels are square. Source: the pinhole model of NeRF's `get_rays`.
    """
    y, x = np.meshgrid(np.arange(h) + 0.5, np.arange(w) + 0.5, indexing="ij")
    local = np.stack([(x - 0.5 * w) / focal, -(y - 0.5 * h) / focal, -np.ones_like(x)], -1)
    directions = np.einsum("...ij,hwj->...hwi", c2w[..., :3, :3], local)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.broadcast_to(c2w[..., None, None, :3, 3], directions.shape), directions


def mitsuba_to_opengl(to_world: np.ndarray) -> np.ndarray:
    """OpenGL camera-to-world (+X right, looks down -Z) of a Mitsuba sensor's `to_world` (+X left, looks along +Z).

    Flips the camera's X and Z axes, (..., 4, 4) -> (..., 4, 4); the flip is its own inverse, so it also leads back.
    """
    return np.asarray(to_world, dtype=np.float64) * np.array([-1.0, 1.0, -1.0, 1.0])
