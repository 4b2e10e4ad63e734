"""Measures one point: its pictures by two seeds or more, and what they took. Maps and atlases are made once, in the
first picture, and kept for the others, so that what is built once is told from what every picture costs."""

import os
import statistics
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ...core.errors import MiNtfError
from ...render.cost.measurement import BUILT, once
from ...render.maps import map_cache
from .points import STOCK, Point
from .subject import Picture, Subject

CHEAP = 1.0
"""Seconds below which a picture is rendered `REPEATS` times warm, dearer ones once."""
REPEATS = 3


@dataclass(frozen=True)
class Timing:
    """Times and memory of one point.

    Seconds: `build` of maps, atlas and the light between patches, without compilation; `compile` of
    kernels in the first picture, or their fetching from Dr.Jit's cache on disk; `first`: the first picture as a whole;
    `render`: the median of `repeats` warm pictures, what is built left out; `peak`: most bytes that Dr.Jit held;
    `load`: jobs that the system ran on average when it was measured."""

    build: float
    compile: float
    first: float
    render: float
    repeats: int
    peak: int
    load: float

    @property
    def total(self) -> float:
        """Seconds of a picture whose kernels are compiled and whose maps are not made yet."""
        return self.build + self.render


@contextmanager
def maps_in_memory() -> Iterator[None]:
    """Within, transmittance maps are kept in memory and in no file, and there are none yet."""
    name = "MI_NTF_CACHE"
    before = os.environ.get(name)
    os.environ[name] = "memory"
    map_cache.forget()
    try:
        yield
    finally:
        map_cache.forget()
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


def measure(subject: Subject, point: Point, picture: Picture, timeout: float = -1.0) -> tuple[list[np.ndarray], Timing]:
    """The pictures (h, w, 3), of seeds 0, 1, …, and their :class:`Timing`. `timeout`: seconds after which a rendering
    ends, between chunks of its pixels; below 0: never. Raises whatever rendering does, and MiNtfError where it did not
    end in time."""
    scene, integrator = subject.load(point, picture), subject.integrator(point, timeout)
    dr.flush_malloc_cache()
    with maps_in_memory():
        image, first = _picture(scene, integrator, point, 0, timeout)
        images, warm = [image], []
        for seed in range(1, REPEATS + 1):
            image, found = _picture(scene, integrator, point, seed, timeout)
            images.append(image)
            warm.append(found)
            if found["wall_seconds"] > CHEAP:
                break
    render = statistics.median(_rest(found, point) for found in warm)
    peak = max(found["peak_bytes"] for found in (first, *warm))
    build = sum(_built(first, point).values())
    return images, Timing(build, first["compile_seconds"], first["wall_seconds"], render, len(warm), peak,
                          round(os.getloadavg()[0], 2))


def _picture(scene, integrator, point: Point, seed: int, timeout: float) -> tuple[np.ndarray, dict]:
    image, found = once(scene, integrator, point.spp, seed)
    took = found["wall_seconds"] - found["compile_seconds"]
    if 0 < timeout < took:
        raise MiNtfError(f"its picture took {took:.0f} s, where {timeout:.0f} s were allowed")
    return colours(image), found


def colours(image: Any) -> np.ndarray:
    """(h, w, 3) of a rendered picture. Raises MiNtfError where a value is not finite."""
    pixels = np.array(image, np.float32)[..., :3]
    if not np.isfinite(pixels).all():
        raise MiNtfError("the picture has pixels that are not finite")
    return pixels


def _built(found: dict, point: Point) -> dict[str, float]:
    """Seconds of the stages that do not grow with the picture."""
    return {} if point.method == STOCK else {name: found["stages"].get(name, 0.0) for name in BUILT}


def _rest(found: dict, point: Point) -> float:
    """Seconds of a picture without compilation and what is built."""
    return max(1e-4, found["wall_seconds"] - found["compile_seconds"] - sum(_built(found, point).values()))
