"""References for the ways of a study: the same field by ``raymarch``, taken to convergence, and the captured mesh."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from .. import mesh_reference
from .errors import Truth
from .measure import LARGEST_PASS, Renderer
from .ways import DRAWN, Subject, Way

ERRORS = (0.1, 0.05, 0.02, 0.01)
"""Relative errors that a reader asks for. The reference's noise need not be below a quarter of the last."""
SAMPLES = 256
"""Samples a pixel that the reference should have: their noise is 1/16 of one sample's."""
SMALLEST = 64
"""Pixels along the shorter side below which no picture is shrunk: details of the object would be gone."""


def marched(subject: Subject) -> Way:
    """Return the reference's way, which has noise in place of bias: twice the steps; light that scatters again traced,
    not taken from between patches; of many lights drawn ones, which cut no environment into cells."""
    properties = subject.properties
    light_samples = properties["light_samples"] or (DRAWN if subject.lights > DRAWN else 0)
    return Way("raymarch", (("samples", min(2 * properties["samples"], 8192)), ("light_samples", light_samples),
                            ("bounces", "paths")))


def renderer(subject: Subject, way: Way, shrink: int, scene: Any = None) -> Renderer:
    """Return what renders the scene by `way`; `scene`: another one in its place."""
    return Renderer(scene or subject.scene(shrink), mi.load_dict({"type": way.plugin, **way.properties(subject)}))


def _rate(render: Renderer) -> float:
    """Return the seconds of a sample of every pixel, after a pass that builds."""
    render(1, 1)
    few, many = (render(n, 2 * n + 1)[1] for n in (2, 8))
    return max(many - few, 0.1 * many) / 6


def choose_shrink(subject: Subject, seconds: float) -> int:
    """Return the least power of two that shrinks the picture so far that a reference of `SAMPLES` samples a pixel takes
    no more than `seconds`, judged by a pilot on a small picture, beyond which it is not shrunk."""
    pilot = max(1, 2 ** int(np.log2(max(min(subject.size) / SMALLEST, 1))))
    per_sample = _rate(renderer(subject, marched(subject), pilot))
    shrink = pilot
    while shrink > 1 and SAMPLES * per_sample * (2 * pilot / shrink) ** 2 <= seconds:
        shrink //= 2
    return shrink


def converge(render: Renderer, pixels: int, seconds: float, tell: Callable[[str], None]) -> tuple[Truth, float]:
    """Render a reference until its noise is negligible or its time is used, in four passes at least. Returns it and the
    seconds of a sample of every pixel."""
    start = time.perf_counter()
    per_sample = _rate(render)
    spp = max(1, min(int((seconds - (time.perf_counter() - start)) / 8 / per_sample), LARGEST_PASS // pixels))
    total: Any = 0.0
    squares: Any = 0.0
    count, spent = 0, 0.0
    while count < 4 or spent * (1 + 1 / count) <= seconds:
        image = render(spp, 2 * count + 1)[0].astype(np.float64)
        count, total, squares = count + 1, total + image, squares + image**2
        spent = time.perf_counter() - start
        variance = max(float(np.mean(squares / count - (total / count) ** 2)), 0.0) / max(count - 1, 1)
        truth = Truth((total / count).astype(np.float32), variance,
                      f"raymarch with {render.integrator.context.settings.samples} steps and {count * spp} samples a pixel")
        tell(f"reference: {count * spp} samples a pixel")
        if count >= 4 and truth.noise <= ERRORS[-1] / 4:
            break
    return truth, per_sample


def captured(subject: Subject, path: Path, shrink: int, seconds: float) -> Truth:
    """Return the picture of the captured mesh: that of an EXR file, or of a scene file, rendered for `seconds`."""
    if path.suffix.lower() != ".xml":
        image = mesh_reference.of_file(path, *subject.pixels(shrink))
        return Truth(image, 0.0, f"{path.name}, whose own noise is not known")
    a = np.stack(mesh_reference.traced(path, subject.parameters, shrink, seconds))
    return Truth(a.mean(0), float(a.var(0, ddof=1).mean()) / len(a),
                 f"{path.name}, path-traced with {16 * len(a)} samples a pixel")
