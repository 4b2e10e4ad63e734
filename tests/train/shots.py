"""Photographs and flashes in memory, without a data set."""

import numpy as np
import torch
from train import two_spheres

from mi_ntf.data.schema import Split
from mi_ntf.train.flash import Flash
from mi_ntf.train.rays import Photographs
from mi_ntf.train.transmittance_targets import TransmittanceTargets


def facing(place) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) of a camera at `place` (3,) that looks at the origin."""
    place = np.asarray(place, np.float64)
    backward = place / np.linalg.norm(place)
    right = np.cross((0.0, 0, 1) if abs(backward[2]) < 0.9 else (0.0, 1, 0), backward)
    c2w = np.eye(4)
    c2w[:3, 0] = right / np.linalg.norm(right)
    c2w[:3, 1] = np.cross(backward, c2w[:3, 0])
    c2w[:3, 2] = backward
    c2w[:3, 3] = place
    return c2w


def around(count: int, distance: float = two_spheres.DISTANCE, seed: int = 0) -> np.ndarray:
    """`count` cameras (count, 4, 4) everywhere around the origin, looking at it."""
    places = np.random.default_rng(seed).normal(size=(count, 3))
    return np.stack([facing(distance * p / np.linalg.norm(p)) for p in places])


def split(images: np.ndarray, focal=50.0, c2w: np.ndarray | None = None, offset=(0.0, 0.0, 0.0), power=1.0,
          **more) -> Split:
    """`images` (N, H, W, 4) as they are stored, of cameras `c2w`; flashes at `offset`, right, up, forward of them, of
    radiant intensity `power`."""
    n, height, width = images.shape[:3]
    c2w = around(n) if c2w is None else c2w
    right, up, forward = offset
    options = {"principal": np.tile([width / 2, height / 2], (n, 1)), "center": np.zeros(3), "radius": 1.0} | more
    return Split(images=images, c2w=c2w, focal=np.broadcast_to(np.asarray(focal, np.float64), (n, 2)).copy(),
                 light_pos=(c2w @ (right, up, -forward, 1.0))[:, :3], light_intensity=np.full((n, 3), power), **options)


def photographs(images: np.ndarray, first: int = 0, **options) -> Photographs:
    """Return the photographs of a :func:`split`; `first` is the number of the first one."""
    return Photographs(split(images, **options), first)


def flash(place: torch.Tensor, marched: TransmittanceTargets, solid: bool = True) -> Flash:
    """Lights at `place` (views, 3), whatever the cameras."""
    lights = Flash([photographs(np.zeros((len(place), 1, 1, 4), np.float32))], solid, marched)
    lights.place = place
    return lights
