"""The curve of one way to render: passes with independent seeds, and the error of their mean after each."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core.errors import MiNtfError
from ...render.maps import map_cache
from ...render.timing import once
from .errors import Estimate, Mean, Truth

TIMES = (1, 3, 10)
"""Seconds after which pictures are compared: the waits of a change by hand, of a try, and of a preview."""
LARGEST_PASS = 1 << 22
"""Camera rays of one pass at most: path tracers hold all of them in memory, some 100 bytes each."""


@dataclass
class Renderer:
    """Renderer of many pictures of a scene by one integrator, which keeps what it has built. `compile`: seconds of
    compilation; `peak`: most bytes that Dr.Jit held."""

    scene: Any
    integrator: Any
    compile: float = 0.0
    peak: int = 0

    def __call__(self, samples: int, seed: int) -> tuple[np.ndarray, float]:
        """Return a picture (h, w, 3) of so many samples a pixel, and its seconds without compilation. Raises MiNtfError
        where a pixel is not finite."""
        image, took = once(self.scene, self.integrator, samples, seed)
        pixels = np.array(image, np.float32)[..., :3]
        if not np.isfinite(pixels).all():
            raise MiNtfError("the picture has pixels that are not finite")
        self.compile += took["compile_seconds"]
        self.peak = max(self.peak, took["peak_bytes"])
        return pixels, max(took["wall_seconds"] - took["compile_seconds"], 1e-4)


@dataclass
class Curve:
    """Points of a curve, JSON-ready; the picture (h, w, 3) at the last point within each of `TIMES`; and at the last of
    all, the difference of its mean brightness from the reference's, with its standard error."""

    points: list[dict[str, Any]] = field(default_factory=list)
    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    shift: tuple[float, float] = 0.0, 0.0

    def add(self, seconds: float, mean: Mean, mesh: Mean | None) -> None:
        """Add the point of `mean`, which took so many seconds; `mesh`: the same held against the mesh."""
        split = mean.split() if mean.pictures > 1 else (None, None)
        values: dict[str, Estimate | None] = {"error": mean.error(), "noise": split[0], "bias": split[1]}
        point: dict[str, Any] = {"seconds": seconds, "samples": mean.samples}
        for name, estimate in (values | ({"mesh_error": mesh.error()} if mesh else {})).items():
            point[name] = estimate and estimate.value
            point[f"{name}_uncertainty"] = estimate and estimate.uncertainty
        self.points.append(point)
        self.shift = mean.shift()
        self.pictures |= {str(mark): mean.image for mark in TIMES if seconds <= mark}


def follow(render: Callable[[int, int], tuple[np.ndarray, float]], truth: Truth, mesh: Truth | None, budget: float,
           tell: Callable[[float], None]) -> Curve:
    """Render passes until `budget` seconds are used, compilation apart, or the noise is below the reference's own or a
    tenth of the bias, where more samples would change the error no more.

    `render` takes samples and a seed and returns a picture and seconds, as :class:`Renderer`; what it builds, it builds
    anew in the first pass, which is rendered whatever it takes. `tell` is called with each error. Passes double the
    samples of all before them, so that what each costs besides its samples does not dominate. Where building uses most
    of the budget, but less than twice as much, a quarter of it is added for samples.
    """
    curve, mean, other = Curve(), Mean(truth), Mean(mesh) if mesh else None
    seconds, samples = 0.0, 1
    with map_cache.in_memory():
        while samples:
            picture, took = render(samples, 2 * mean.pictures)  # references have odd seeds
            seconds += took
            mean.add(picture, samples)
            if other:
                other.add(picture, samples)
            curve.add(seconds, mean, other)
            tell(curve.points[-1]["error"])
            if mean.pictures == 1 and budget / 2 < seconds < 2 * budget:  # for building: samples have some of it, too
                budget = max(budget, seconds + budget / 4)
            noise, bias = (e.value for e in mean.split()) if mean.pictures > 1 else (1.0, 0.0)
            if seconds >= budget or noise < max(truth.noise, bias / 10):
                break
            fit = (budget - seconds) / took * samples if mean.pictures > 1 else 1.0
            mark = next(((t - seconds) / took * samples for t in TIMES if t > seconds), 0.0)
            samples = following(mean.samples, fit, mark, LARGEST_PASS // picture[..., 0].size)
    return curve


def following(samples: int, fit: float, mark: float, largest: int) -> int:
    """Return the samples of the next pass: those so far, fewer where only these fit, none where less than half do.

    `samples` were rendered, `fit` fit into the rest of the time, `mark` into the time until pictures are compared next,
    `largest` into one pass.
    """
    wanted = min(samples, int(fit))
    if samples <= 2 * int(mark) < 2 * wanted:
        wanted = int(mark)
    return max(1, min(wanted, largest)) if 2 * wanted >= samples else 0
