"""References of a study: the same field by a converged ``raymarch``, and the captured mesh, path-traced."""

import math
import re
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...render.scene import scene_file
from ..compare import read_image
from .errors import Truth
from .measure import LARGEST_PASS, Renderer
from .ways import SAMPLED, Subject, Way, shrinker

ERRORS = (0.1, 0.05, 0.02, 0.01)
"""Relative errors of the report. The noise of the reference need not be below a quarter of the last one."""
SAMPLES = 256
"""Samples a pixel that the reference should have: their noise is 1/16 of that of one sample."""
SMALLEST = 64
"""Pixels along the shorter side below which no picture is shrunk, since details of the object would be lost."""
MESH_SAMPLES = 16
"""Samples a pixel of each picture of the captured mesh."""


def marched(subject: Subject) -> Way:
    """Return the reference's way, which has noise in place of bias.

    It marches twice the steps, traces light that scatters again, and samples many lights, which cuts no environment
    into cells.
    """
    properties = subject.properties
    light_samples = properties["light_samples"] or (SAMPLED if subject.lights > SAMPLED else 0)
    return Way("raymarch", (("samples", subject.finer_steps), ("light_samples", light_samples),
                            ("bounces", "paths")))


def renderer(subject: Subject, way: Way, shrink: int, scene: "mi.Scene | None" = None) -> Renderer:
    """Return the renderer of the scene, or of another `scene`, by `way`."""
    integrator = mi.load_dict({"type": way.plugin, **way.properties(subject)})
    assert isinstance(integrator, mi.Integrator)
    return Renderer(scene or subject.scene(shrink), integrator)


def _rate(render: Renderer) -> float:
    """Return the seconds of a sample of every pixel, after a pass that builds maps."""
    render(1, 1)
    few, many = (render(n, 2 * n + 1)[1] for n in (2, 8))
    return max(many - few, 0.1 * many) / 6


def choose_shrink(subject: Subject, seconds: float, whole: bool = False) -> int:
    """Return the power of two by which pictures are shrunk, so that a reference takes no more than `seconds`.

    The time is judged by a pilot with a small picture, and pictures are not shrunk further than that. With `whole`,
    each of their pixels covers whole pixels of the scene's own picture.
    """
    pilot: int = max(1, 2 ** int(np.log2(max(min(subject.size) / SMALLEST, 1))))
    if whole:
        pilot = math.gcd(pilot, *subject.size)
    per_sample = _rate(renderer(subject, marched(subject), pilot))
    shrink = pilot
    while shrink > 1 and SAMPLES * per_sample * (2 * pilot / shrink) ** 2 <= seconds:
        shrink //= 2
    return shrink


def converge(render: Renderer, pixels: int, steps: int, seconds: float, tell: Callable[[str], None]
             ) -> tuple[Truth, float]:
    """Render a reference in four passes or more, until its noise is negligible or its time is used.

    `pixels` are those of the picture, `steps` those of the march. Returns the reference, and the seconds of a sample of
    every pixel.
    """
    start = time.perf_counter()
    per_sample = _rate(render)
    spp = max(1, min(int((seconds - (time.perf_counter() - start)) / 8 / per_sample), LARGEST_PASS // pixels))
    total, squares = np.zeros(1), np.zeros(1)
    count, spent = 0, 0.0
    while count < 4 or spent * (1 + 1 / count) <= seconds:
        image = render(spp, 2 * count + 1)[0].astype(np.float64)
        count, total, squares = count + 1, total + image, squares + image**2
        spent = time.perf_counter() - start
        variance = max(float(np.mean(squares / count - (total / count) ** 2)), 0.0) / max(count - 1, 1)
        truth = Truth((total / count).astype(np.float32), variance,
                      f"raymarch with {steps} steps and {count * spp} samples a pixel")
        tell(f"reference: {count * spp} samples a pixel")
        if count >= 4 and truth.noise <= ERRORS[-1] / 4:
            break
    return truth, per_sample


def shipped(scene: Path, parameters: dict[str, str]) -> Path | None:
    """Return the file ``reference_LIGHT.exr`` beside a scene file, if it exists.

    LIGHT is the value of the scene's ``$light``.
    """
    text = scene.read_text(encoding="utf-8", errors="replace")
    default = re.search(r'<default\s+name="light"\s+value="([^"]*)"', text)
    light = parameters.get("light") or (default.group(1) if default else "")
    path = scene.parent / f"reference_{light}.exr"
    return path if light and path.is_file() else None


def captured(subject: Subject, path: Path, shrink: int, seconds: float) -> Truth:
    """Return the picture of the captured mesh: that of an EXR file, or of a scene file, rendered for `seconds`.

    Raises MiNtfError where the size of the file is no whole multiple of that of the study's pictures.
    """
    if path.suffix.lower() == ".xml":
        images = _traced(path, subject, shrink, seconds)
        return Truth(images.mean(0), float(images.var(0, ddof=1).mean()) / len(images),
                     f"{path.name}, path-traced with {MESH_SAMPLES * len(images)} samples a pixel")
    image, (width, height) = read_image(path)[..., :3], subject.pixels(shrink)
    block = image.shape[0] // height
    if not block or image.shape[:2] != (block * height, block * width):
        raise MiNtfError(f"reference {path} has {image.shape[1]}×{image.shape[0]} pixels, the study's pictures "
                         f"{width}×{height}; give one of a whole multiple of them")
    means = image.reshape(height, block, width, block, 3).mean((1, 3))
    return Truth(means, 0.0, f"{path.name}, whose own noise is not known")


def _traced(path: Path, subject: Subject, shrink: int, seconds: float) -> np.ndarray:
    """Return four or more pictures (n, h, w, 3) of a scene file by independent seeds and its own integrator.

    Values for $names that the file lacks are ignored.
    """
    start = time.perf_counter()
    scene = scene_file.load(path, subject.parameters, subject.env, change=shrinker(shrink), strict=False)
    images: list[np.ndarray] = []
    while len(images) < 4 or time.perf_counter() - start < seconds:
        image, *_ = Renderer(scene, scene.integrator())(MESH_SAMPLES, 2 * len(images) + 1)
        width, height = subject.pixels(shrink)
        if image.shape[:2] != (height, width):
            raise MiNtfError(f"reference {path} renders {image.shape[1]}×{image.shape[0]} pixels where the study's "
                             f"scene has {width}×{height}; give both films one size")
        images.append(image)
    return np.stack(images)
