"""A small data set without a renderer: two Lambert spheres, ray-traced in NumPy with the light at the lens."""

import dataclasses
from pathlib import Path

import numpy as np

from mi_ntf.data import schema

SPHERES = (((-0.25, 0.0, 0.1), 0.45, (0.7, 0.3, 0.2)), ((0.4, 0.25, -0.2), 0.3, (0.2, 0.4, 0.6)))
INTENSITY = 30.0
DISTANCE = 3.2


def coarsen(monkeypatch) -> None:
    """The preset `fast` on grids whose upkeep takes no longer than its steps: for runs of some steps that need not
    learn."""
    from mi_ntf.train import config, evaluate

    monkeypatch.setitem(config.PRESETS, "fast", dataclasses.replace(config.PRESETS["fast"], cells=48, bake=64))
    monkeypatch.setattr(evaluate, "CELLS", 32)


def camera(direction: np.ndarray) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) at DISTANCE along the unit `direction`, looking at the origin."""
    right = np.cross((0.0, 0.0, 1.0), direction)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([right, np.cross(direction, right), direction], axis=1)
    c2w[:3, 3] = DISTANCE * direction
    return c2w


def photograph(c2w: np.ndarray, focal: float, size: int, oversample: int = 3) -> np.ndarray:
    """Premultiplied RGBA (size, size, 4): albedo/π · cos · I/d², box filter."""
    n = size * oversample
    o, d = schema.pixel_rays(c2w, focal * oversample, n, n)
    nearest, image = np.full((n, n), np.inf), np.zeros((n, n, 4))
    for center, radius, albedo in SPHERES:
        b = np.sum((o - center) * d, -1)
        disc = b**2 - np.sum((o - center) ** 2, -1) + radius**2
        t = np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf)
        hit = t < nearest
        nearest = np.where(hit, t, nearest)
        x = o + np.where(hit, t, 0)[..., None] * d
        cos = -np.sum((x - center) / radius * d, -1)
        value = np.asarray(albedo) / np.pi * (cos * INTENSITY / np.where(hit, t, 1) ** 2)[..., None]
        image[hit] = np.concatenate([value, np.ones((n, n, 1))], -1)[hit]
    return image.reshape(size, oversample, size, oversample, 4).mean((1, 3))


def write(folder: Path, views: dict[str, int] | None = None, size: int = 32) -> Path:
    """Write a data set of `views` (split → count) photographs and return its folder."""
    rng = np.random.default_rng(7)
    angle = 0.62
    for split, count in (views or {"train": 16, "val": 2, "test": 2}).items():
        frames = []
        (folder / split).mkdir(parents=True)
        for i in range(count):
            direction = rng.normal(size=3)
            c2w = camera(direction / np.linalg.norm(direction))
            name = f"{split}/{i:04d}.exr"
            schema.write_exr(folder / name, photograph(c2w, schema.focal_length(angle, size), size))
            frames.append(schema.Frame(name, c2w, c2w[:3, 3], np.full(3, INTENSITY)))
        schema.write_transforms(folder, split, schema.Transforms(angle, size, size, np.zeros(3), 1.0, frames))
    return folder
