"""The curve of one way to render: passes with independent seeds, and the error of their mean after each."""

from collections.abc import Callable
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...render.maps import map_cache
from ...render.timing import once
from ..limits import Json
from .errors import Estimate, Mean, Truth

TIMES = (1, 3, 10)
"""Seconds after which pictures are compared: waiting times for an edit, a test and a preview."""
LARGEST_PASS = 1 << 22
"""Largest number of camera rays of one pass; path tracers store all of them, some 100 bytes each."""


@dataclass
class Renderer:
    """Renderer of many pictures of a scene by one integrator, which keeps its maps.

    - compile: seconds of compilation so far
    - peak: largest number of bytes that Dr.Jit has allocated
    """

    scene: "mi.Scene"
    integrator: "mi.Integrator"
    compile: float = 0.0
    peak: int = 0

    def __call__(self, samples: int, seed: int) -> tuple[np.ndarray, float, float]:
        """Return a picture (h, w, 3) of so many samples a pixel, its seconds, and those that built its maps.

        Neither contains compilation.

        Raises MiNtfError where a pixel is not finite.
        """
        image, times = once(self.scene, self.integrator, samples, seed)
        pixels = np.array(image, np.float32)[..., :3]
        if not np.isfinite(pixels).all():
            raise MiNtfError("the picture has pixels that are not finite")
        self.compile += times["compile_seconds"]
        self.peak = max(self.peak, times["peak_bytes"])
        return pixels, max(times["wall_seconds"] - times["compile_seconds"], 1e-4), times["build_seconds"]


@dataclass
class Curve:
    """Error over time of one way to render.

    - points: values of each point, for JSON
    - pictures: picture (h, w, 3) at the last point within each of `TIMES`
    - shift: relative difference of mean brightness from the reference at the last point, and its standard error
    """

    points: list[Json] = field(default_factory=list)
    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    shift: tuple[float, float] = 0.0, 0.0

    def add(self, seconds: float, mean: Mean, mesh: Mean | None) -> None:
        """Add the point of `mean`, which took so many seconds; `mesh` is the same mean compared with the mesh."""
        split = mean.split() if mean.pictures > 1 else (None, None)
        values: dict[str, Estimate | None] = {"error": mean.error(), "noise": split[0], "bias": split[1]}
        point: Json = {"seconds": seconds, "samples": mean.samples}
        for name, estimate in (values | ({"mesh_error": mesh.error()} if mesh else {})).items():
            point[name] = estimate and estimate.value
            point[f"{name}_uncertainty"] = estimate and estimate.uncertainty
        self.points.append(point)
        self.shift = mean.shift()
        self.pictures |= {str(mark): mean.image for mark in TIMES if seconds <= mark}


def follow(render: Callable[[int, int], tuple[np.ndarray, float, float]], truth: Truth, mesh: Truth | None,
           budget: float, tell: Callable[[float], None]) -> Curve:
    """Render passes until `budget` seconds are used, compilation excluded, or noise no longer matters.

    Noise no longer matters below that of the reference or below a tenth of the bias. Every pass doubles the samples, so
    that its fixed costs do not dominate. If building maps uses half of the budget to twice the budget, a quarter of the
    budget is added for samples.

    Parameters
    ----------
    render
        Function of samples and a seed that returns a picture, its seconds, and those that built its maps, such as a
        :class:`Renderer`. It builds its maps in the first pass, which is rendered whatever it takes.
    truth, mesh
        The reference, and the captured mesh if there is one.
    tell
        Called with each error.
    """
    curve, mean, other = Curve(), Mean(truth), Mean(mesh) if mesh else None
    seconds, samples = 0.0, 1
    with map_cache.in_memory():
        while samples:
            picture, duration, building = render(samples, 2 * mean.pictures)  # references have odd seeds
            seconds += duration
            mean.add(picture, samples)
            if other:
                other.add(picture, samples)
            curve.add(seconds, mean, other)
            tell(curve.points[-1]["error"])
            if mean.pictures == 1 and budget / 2 < building < 2 * budget:
                budget = max(budget, seconds + budget / 4)
            noise, bias = (e.value for e in mean.split()) if mean.pictures > 1 else (1.0, 0.0)
            if seconds >= budget or noise < max(truth.noise, bias / 10):
                break
            per_sample = max(duration - building, 1e-4) / samples
            fit = (budget - seconds) / per_sample
            mark = next(((t - seconds) / per_sample for t in TIMES if t > seconds), 0.0)
            samples = following(mean.samples, fit, mark, LARGEST_PASS // picture[..., 0].size)
    return curve


def following(samples: int, fit: float, mark: float, largest: int) -> int:
    """Return the samples of the next pass: as many as so far, or fewer if only these fit; 0 if less than half fit.

    Parameters
    ----------
    samples
        Samples a pixel so far.
    fit, mark
        Samples that fit into the remaining time, and into the time until pictures are compared next.
    largest
        Largest number of samples of one pass.
    """
    count = min(samples, int(fit))
    if samples <= 2 * int(mark) < 2 * count:
        count = int(mark)
    return max(1, min(count, largest)) if 2 * count >= samples else 0
