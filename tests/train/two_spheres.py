"""A small data set without a renderer: two Lambert spheres, ray-traced in NumPy, the light at the lens or beside it."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from mi_ntf.data import schema

SPHERES = (((-0.25, 0.0, 0.1), 0.45, (0.7, 0.3, 0.2)), ((0.4, 0.25, -0.2), 0.3, (0.2, 0.4, 0.6)))
INTENSITY = 30.0
DISTANCE = 3.2


def coarsen(monkeypatch) -> None:
    """Give the preset `fast` coarse grids, for runs of a few steps that need not learn."""
    from mi_ntf.train import config, scoring

    monkeypatch.setitem(config.PRESETS, "fast", dataclasses.replace(config.PRESETS["fast"], cells=48, bake=64))
    monkeypatch.setattr(scoring, "CELLS", 32)


def glance(monkeypatch) -> None:
    """Compare finished fields with 500 pixels of the photographs, for runs whose scores do not matter."""
    from mi_ntf.train import scoring

    whole = scoring.score

    def score(field, photographs, most, views=None, passes=1):
        return whole(field, photographs, min(most, 500), views, passes)

    monkeypatch.setattr(scoring, "score", score)


def camera(direction: np.ndarray) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) at DISTANCE along the unit `direction`, looking at the origin."""
    right = np.cross((0.0, 0.0, 1.0), direction)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([right, np.cross(direction, right), direction], axis=1)
    c2w[:3, 3] = DISTANCE * direction
    return c2w


def photograph(c2w: np.ndarray, focal: float, size: int, oversample: int = 3, offset=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Premultiplied RGBA (size, size, 4): albedo/π · cos · I/d², box filter. The light is `offset`, right, up, forward,
    from the lens; what one sphere sends to the other is left out, the shadow that it throws is not."""
    n = size * oversample
    o, d = schema.pixel_rays(c2w, focal * oversample, n, n)
    light = flash(c2w, offset)
    nearest, image = np.full((n, n), np.inf), np.zeros((n, n, 4))
    for center, radius, albedo in SPHERES:
        t = _meet(o, d, center, radius)
        hit = t < nearest
        nearest = np.where(hit, t, nearest)
        x = o + np.where(hit, t, 1)[..., None] * d
        toward_light = light - x
        distance = np.linalg.norm(toward_light, axis=-1)
        toward_light = toward_light / distance[..., None]
        cos = np.maximum(np.sum((x - center) / radius * toward_light, -1), 0)
        for other in SPHERES:
            if other[0] != center and any(offset):
                between = _meet(x, toward_light, *other[:2])
                cos = np.where((between > 0) & (between < distance), 0, cos)
        value = np.asarray(albedo) / np.pi * (cos * INTENSITY / distance**2)[..., None]
        image[hit] = np.concatenate([value, np.ones((n, n, 1))], -1)[hit]
    return image.reshape(size, oversample, size, oversample, 4).mean((1, 3))


def flash(c2w: np.ndarray, offset) -> np.ndarray:
    """Return the position of a light at `offset`, right, up, forward, from the lens."""
    right, up, forward = offset
    return (c2w @ (right, up, -forward, 1.0))[:3]


def _meet(o: np.ndarray, d: np.ndarray, center, radius: float) -> np.ndarray:
    """Return the distances at which rays enter a sphere; infinity where they miss it."""
    b = np.sum((o - center) * d, -1)
    disc = b**2 - np.sum((o - center) ** 2, -1) + radius**2
    return np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf)


def gains(split: str, count: int) -> np.ndarray:
    """Factors (count, 3) of the photographs of a split whose exposure and white balance change: 0.5 to 2."""
    return 2 ** np.random.default_rng(list(split.encode())).uniform(-1, 1, (count, 3))


def write(folder: Path, views: dict[str, int] | None = None, size: int = 32, offset=(0.0, 0.0, 0.0),
          left_out: tuple[str, ...] = ()) -> Path:
    """Write a data set of `views` (split → count) photographs and return its folder.

    `offset`: the light's place, as of :func:`photograph`. `left_out`: what the data set does not say, of `pl_pos`, and
    `pl_intensity`, without which photographs have :func:`gains`.
    """
    rng = np.random.default_rng(7)
    angle = 0.62
    for split, count in (views or {"train": 16, "val": 2, "test": 2}).items():
        frames = []
        (folder / split).mkdir(parents=True)
        factors = gains(split, count) if "pl_intensity" in left_out else np.ones((count, 3))
        for i in range(count):
            direction = rng.normal(size=3)
            c2w = camera(direction / np.linalg.norm(direction))
            name = f"{split}/{i:04d}.exr"
            picture = photograph(c2w, schema.focal_length(angle, size), size, offset=offset)
            schema.write_exr(folder / name, picture * (*factors[i], 1))
            frames.append(schema.Frame(name, c2w, flash(c2w, offset), np.full(3, INTENSITY)))
        path = schema.write_transforms(folder, split, schema.Transforms(angle, size, size, np.zeros(3), 1.0, frames))
        if left_out:
            data = json.loads(path.read_text())
            data["frames"] = [{k: v for k, v in frame.items() if k not in left_out} for frame in data["frames"]]
            path.write_text(json.dumps(data))
    return folder
