"""A tiny scene (two analytic spheres, flash at the lens) written in every form that is read."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from train import two_spheres

from mi_ntf.data import estimates, schema
from mi_ntf.data.poses import view_directions

SIZE, ANGLE, VIEWS = 24, 0.62, 16
FOCAL = schema.focal_length(ANGLE, SIZE)
SCALE = 0.5  # keeps radiance below 1, which is as bright as 8 bits get
INTENSITY = SCALE * two_spheres.INTENSITY


C2W = np.stack([two_spheres.camera(d) for d in view_directions(VIEWS, np.random.default_rng(5))])
"""(VIEWS, 4, 4) OpenGL camera-to-world around the spheres."""
PICTURES = np.stack([two_spheres.photograph(c, FOCAL, SIZE) * (SCALE, SCALE, SCALE, 1) for c in C2W])
"""(VIEWS, SIZE, SIZE, 4) linear premultiplied RGBA."""
SPHERES = [(np.array(center), radius) for center, radius, _ in two_spheres.SPHERES]


def true_bounds() -> tuple[np.ndarray, float]:
    """Return the smallest sphere around two spheres: its centre is on the line through their centres."""
    (a, r), (b, s) = SPHERES
    along = (b - a) / np.linalg.norm(b - a)
    return estimates.bounding_sphere(np.stack([a - r * along, b + s * along]))


def straight_srgb(picture: np.ndarray) -> np.ndarray:
    """8-bit RGBA (H, W, 4), sRGB and straight alpha, of linear premultiplied RGBA."""
    alpha = picture[..., 3:]
    rgb = picture[..., :3] / np.maximum(alpha, 1e-6)
    srgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * np.maximum(rgb, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * np.concatenate([srgb, alpha], -1).clip(0, 1)).astype(np.uint8)


def _save(folder: Path, name: str, picture: np.ndarray) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        schema.write_exr(path, picture)
    else:
        Image.fromarray(straight_srgb(picture)).save(path)


def splits() -> dict[str, range]:
    """Return the views of train, val and test."""
    return {"train": range(VIEWS - 2), "val": range(VIEWS - 2, VIEWS - 1), "test": range(VIEWS - 1, VIEWS)}


def capture(folder: Path) -> Path:
    """Write the set as `mi-ntf capture` does."""
    for split, views in splits().items():
        frames = []
        for i in views:
            _save(folder, f"{split}/{i:04d}.exr", PICTURES[i])
            frames.append(schema.Frame(f"{split}/{i:04d}.exr", C2W[i], C2W[i, :3, 3], np.full(3, INTENSITY)))
        schema.write_transforms(folder, split, schema.Transforms(ANGLE, SIZE, SIZE, np.zeros(3), 1.0, frames))
    return folder


def blender(folder: Path) -> Path:
    """Write the set as NeRF-synthetic has it: PNG, names without extension, no light and no size."""
    for split, views in splits().items():
        frames = []
        for i in views:
            _save(folder, f"{split}/r_{i}.png", PICTURES[i])
            frames.append({"file_path": f"./{split}/r_{i}", "rotation": 0.01, "transform_matrix": C2W[i].tolist()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
    return folder


def nrhints(folder: Path) -> Path:
    """Write the set as NRHints has it: light positions, intrinsics [cx, cy, fx, fy], extensions apart from names."""
    for split, views in splits().items():
        frames = []
        for i in views:
            _save(folder, f"{split}/r_{i:04d}.exr", PICTURES[i])
            frames.append({"file_path": f"./{split}/r_{i:04d}", "file_ext": ".exr", "pl_pos": C2W[i, :3, 3].tolist(),
                           "transform_matrix": C2W[i].tolist()})
        text = {"camera_intrinsics": [SIZE / 2, SIZE / 2, FOCAL, FOCAL], "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(text))
    return folder


def colmap(folder: Path, model: str = "PINHOLE", points: bool = True) -> Path:
    """Write COLMAP's text export: world-to-camera, OpenCV axes; masks beside opaque photographs."""
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    numbers = {"PINHOLE": [FOCAL, FOCAL, SIZE / 2, SIZE / 2], "SIMPLE_PINHOLE": [FOCAL, SIZE / 2, SIZE / 2],
               "OPENCV": [FOCAL, FOCAL, SIZE / 2, SIZE / 2, 0.02, 0, 0, 0],
               "OPENCV_FISHEYE": [FOCAL, FOCAL, SIZE / 2, SIZE / 2, 0.1, 0, 0, 0]}[model]
    (place / "cameras.txt").write_text(f"# comment\n1 {model} {SIZE} {SIZE} {' '.join(map(str, numbers))}\n")
    lines = []
    for i, c2w in enumerate(C2W):
        rgba = straight_srgb(PICTURES[i])
        for kind, part in (("images", rgba[..., :3]), ("masks", rgba[..., 3])):
            (folder / kind).mkdir(exist_ok=True)
            Image.fromarray(np.ascontiguousarray(part)).save(folder / kind / f"{i:03d}.png")
        rotation = (c2w[:3, :3] * (1, -1, -1)).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        pose = [w, x, y, z, *(-rotation @ c2w[:3, 3])]
        lines.append(f"{i + 1} {' '.join(repr(float(p)) for p in pose)} 1 {i:03d}.png\n\n")
    (place / "images.txt").write_text("".join(reversed(lines)))  # any order
    cloud = surface_points() if points else []
    (place / "points3D.txt").write_text("".join(
        f"{k + 1} {p[0]!r} {p[1]!r} {p[2]!r} 9 9 9 0.5\n" for k, p in enumerate(np.asarray(cloud).tolist())))
    return folder


def nerfstudio(folder: Path) -> Path:
    """Write the set as `ns-process-data` does: one file, intrinsics in pixels, splits by lists of names."""
    frames = []
    for i, c2w in enumerate(C2W):
        _save(folder, f"images/frame_{i:05d}.png", PICTURES[i])
        frames.append({"file_path": f"./images/frame_{i:05d}.png", "transform_matrix": c2w.tolist(), "colmap_im_id": i})
    lists = {f"{split}_filenames": [f"images/frame_{i:05d}.png" for i in views] for split, views in splits().items()}
    text = {"camera_model": "OPENCV", "w": SIZE, "h": SIZE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE / 2,
            "cy": SIZE / 2, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "frames": frames, **lists}
    (folder / "transforms.json").write_text(json.dumps(text))
    return folder


def llff(folder: Path, factor: int = 1) -> Path:
    """Write the set as LLFF's `imgs2poses.py` does: poses of photographs `factor` times as large as the files."""
    rows = []
    for i, c2w in enumerate(C2W):
        _save(folder, f"images/IMG_{i:03d}.png", PICTURES[i])
        right, up, backward, place = c2w[:3].T
        matrix = np.stack([-up, right, backward, place, factor * np.array([SIZE, SIZE, FOCAL])], -1)
        rows.append([*matrix.ravel(), 2.0, 5.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def surface_points(count: int = 200) -> np.ndarray:
    """Points (count, 3) on the two spheres, and a tenth of outliers far behind."""
    rng = np.random.default_rng(1)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    points = np.concatenate([center + radius * part for (center, radius), part in zip(SPHERES, np.split(d, 2),
                                                                                     strict=True)])
    points[::10] *= 40
    return points
