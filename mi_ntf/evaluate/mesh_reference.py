"""Pictures of the captured mesh, path-traced: what shipped scenes have beside them, and other ones."""

import re
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from ..render.scene import changed
from .compare import read_image


def shipped(scene: Path, parameters: dict[str, str]) -> Path | None:
    """Return ``reference_LIGHT.exr`` beside a scene file, LIGHT the value of its ``$light``; None where there is none.
    """
    text = scene.read_text(encoding="utf-8", errors="replace")
    default = re.search(r'<default\s+name="light"\s+value="([^"]*)"', text)
    light = parameters.get("light") or (default.group(1) if default else "")
    path = scene.parent / f"reference_{light}.exr"
    return path if light and path.is_file() else None


def of_file(path: Path, width: int, height: int) -> np.ndarray:
    """Return the picture (h, w, 3) of an EXR file, means of blocks of its pixels. Raises MiNtfError where its size is
    no whole multiple of the one wanted."""
    image = read_image(path)[..., :3]
    block = image.shape[0] // height
    if not block or image.shape[:2] != (block * height, block * width):
        raise MiNtfError(f"reference {path} has {image.shape[1]}×{image.shape[0]} pixels, the study's pictures "
                         f"{width}×{height}; give one of a whole multiple of them")
    return image.reshape(height, block, width, block, 3).mean((1, 3))


def traced(path: Path, parameters: dict[str, str], shrink: int, seconds: float) -> list[np.ndarray]:
    """Return pictures (h, w, 3) of 16 samples a pixel by independent seeds, four or more.

    Parameters
    ----------
    path, parameters
        Scene file, rendered by its own integrator, and values of its $names; those that it lacks are ignored.
    shrink
        Number of its pixels, along each side, that become one.
    seconds
        Time to render for.
    """
    def change(node) -> None:
        if node.type == mi.ObjectType.Film:
            changed.shrink_film(node.props, shrink)

    start, scene = time.perf_counter(), changed.load(path, parameters, change, strict=False)
    images: list[np.ndarray] = []
    seed: Any
    while len(images) < 4 or time.perf_counter() - start < seconds:
        seed = 2 * len(images) + 1
        images.append(np.array(mi.render(scene, seed=seed, spp=16), np.float32)[..., :3])
    return images
