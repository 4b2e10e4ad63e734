"""What points are held against: the same field by `raymarch` taken to convergence, itself held against stock `volpath`;
and, where there is one, the path-traced mesh."""

import contextlib
import itertools
import re
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...jobs import Workers, each
from ...render import register
from ...render.cost.measurement import once
from ...render.scene import changed
from ..compare import read_image
from . import errors
from .measure import colours
from .points import STOCK, Point
from .subject import Picture, Subject, resize

FIRST_SEED = 1 << 20
"""Seeds of references begin here: none is a point's."""
MANY_LIGHTS = 32
"""More lights than these are drawn for the reference, `DRAWN` a shading point, rather than summed: their noise goes the
way of the pixel's own, and no environment is cut into cells."""
DRAWN = 4
SAMPLES = 192
"""Samples a pixel that the reference should have at least: the picture is shrunk until they fit."""
PASSES = 4
SMALLEST = 48
"""Pixels along the shorter side below which no picture is shrunk."""
TARGET = 0.003
"""Relative noise at which the reference is good enough."""
CROP = 16
"""Pixels along the sides of the crop that stock `volpath` renders."""
LARGEST_PASS = 1 << 22
"""Camera rays of one pass of the reference."""


@dataclass
class Reference:
    """`image` (h, w, 3), mean of passes; `variance`: its mean squared noise; `spp`: samples a pixel of all passes."""

    image: np.ndarray
    variance: float
    spp: int
    passes: int
    seconds: float
    about: str = ""

    @property
    def noise(self) -> float:
        """Relative."""
        power = max(float(np.mean(self.image.astype(np.float64) ** 2)) - self.variance, 1e-30)
        return float(np.sqrt(self.variance / power))


def way(subject: Subject) -> Point:
    """How the reference is rendered: twice the steps, many lights drawn."""
    base = subject.base
    drawn = max(DRAWN, base.light_samples) if subject.lights > MANY_LIGHTS or base.light_samples else 0
    return replace(base, method="raymarch", samples=min(2 * base.samples, 8192), light_samples=drawn,
                   environment_lights=max(base.environment_lights, 1), map_source="field", spp=1)


class Renderer:
    """A point's renderings one after the other, of one picture, timed; kernels and what is built are kept."""

    def __init__(self, subject: Subject, point: Point, picture: Picture):
        self._scene = subject.load(point, picture)
        self._integrator = subject.integrator(point)
        width, height = picture.crop[2:] if picture.crop else (n // picture.shrink for n in subject.size)
        self.pixels = width * height

    def __call__(self, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """(h, w, 3), and seconds without compilation."""
        image, found = once(self._scene, self._integrator, spp, seed)
        return colours(image), found["wall_seconds"] - found["compile_seconds"]


def _rates(render: Renderer) -> tuple[float, float]:
    """Seconds of a sample of every pixel, and of a picture besides; after a first rendering, which compiles and builds.
    """
    render(1, FIRST_SEED - 1)
    few, many = (render(n, FIRST_SEED - n)[1] for n in (2, 6))
    per_sample = max(many - few, 0.1 * many) / 4
    return per_sample, max(0.0, few - 2 * per_sample)


def choose_picture(subject: Subject, seconds: float) -> tuple[Picture, str]:
    """The largest film, the scene's or one a power of two smaller, on which a reference of `SAMPLES` samples takes
    `seconds`, by a pilot; and a sentence on it."""
    width, height = subject.size
    pilot = Picture(max(1, 2 ** int(np.log2(max(min(width, height) / 64, 1)))))
    render = Renderer(subject, way(subject), pilot)
    per_sample, fixed = _rates(render)
    per_ray = per_sample / render.pixels
    shrink = 1
    while (min(width, height) // (2 * shrink) >= SMALLEST
           and PASSES * fixed + SAMPLES * per_ray * (width // shrink) * (height // shrink) > seconds):
        shrink *= 2
    size = f"{width // shrink}×{height // shrink}"
    if shrink == 1:
        return Picture(), f"The picture is the scene's own, {size} pixels."
    return Picture(shrink), (f"The picture is {size} pixels in place of the scene's {width}×{height}, so that a "
                             f"reference fits into the budget: rendering the scene's own takes about {shrink**2} times "
                             "the seconds per sample, building the same. A larger --budget takes larger pictures.")


@dataclass(frozen=True)
class Pass:
    """One pass of the reference of a scene file, for a worker."""

    path: Path
    parameters: tuple[tuple[str, str], ...]
    variant: str
    picture: Picture
    spp: int
    seed: int

    @property
    def subject(self) -> tuple:
        """What it has in common with the others."""
        return self.path, self.parameters, self.variant, self.picture


_kept: list[tuple[tuple, Renderer]] = []
"""Of this process, from pass to pass."""


def one_pass(task: Pass) -> np.ndarray:
    """Its picture (h, w, 3), in any process."""
    if not _kept or _kept[0][0] != task.subject:
        mi.set_variant(task.variant)
        register()
        subject = Subject(task.path, dict(task.parameters))
        _kept[:] = [(task.subject, Renderer(subject, way(subject), task.picture))]
    return _kept[0][1](task.spp, task.seed)[0]


def _passes(render: Renderer, spp: int, subject: Subject, picture: Picture, workers: Workers,
            folder: Path | None) -> Generator[np.ndarray, None, None]:
    """Pictures of one seed after the other, by `render` here or by `workers`, without an end."""
    if workers.here:
        for seed in itertools.count(FIRST_SEED):
            yield render(spp, seed)[0]
    parameters = tuple(sorted(subject.parameters.items()))
    tasks = [Pass(subject.path.absolute(), parameters, str(mi.variant()), picture, spp, FIRST_SEED + k)
             for k in range(1 << 12)]
    with contextlib.closing(each(one_pass, tasks, workers, title="passes", folder=folder, quiet=True)) as ends:
        for done in ends:
            if done.error:
                raise MiNtfError(f"a pass of the reference failed: {done.error}")
            yield done.value


def converge(subject: Subject, picture: Picture, seconds: float, tell: Callable[[str], None],
             workers: Workers = Workers(), folder: Path | None = None) -> Reference:  # noqa: B008
    """The field by `raymarch` until its noise is below `TARGET` or `seconds` are over, four passes at least. The passes
    are those of `workers`, `folder` for their files; how large one is, is measured here."""
    point = way(subject)
    start = time.perf_counter()
    render = Renderer(subject, point, picture)
    per_sample, fixed = _rates(render)
    left = max(seconds - (time.perf_counter() - start), 0.0)
    spp = int((left / PASSES - fixed) / per_sample)
    spp = max(1, min(spp, LARGEST_PASS // render.pixels))
    with contextlib.closing(_passes(render, spp, subject, picture, workers, folder)) as images:
        found = _mean(images, spp, seconds, start, tell)
    lights = f"{point.light_samples} drawn lights a point" if point.light_samples else "all lights"
    found.about = (f"`raymarch`, {point.samples} steps, {lights}, {found.spp} samples a pixel in {found.passes} "
                   f"passes, {found.seconds:.0f} s")
    return found


def _mean(images: Iterable[np.ndarray], spp: int, seconds: float, start: float,
          tell: Callable[[str], None]) -> Reference:
    """The mean of so many of `images`, of `spp` samples a pixel each, that it suffices. `start`: when it was begun."""
    total: Any = 0.0
    squares: Any = 0.0
    for count, image in enumerate(images, 1):
        image = image.astype(np.float64)
        total, squares = total + image, squares + image**2
        if count < PASSES:
            continue
        mean = total / count
        variance = max(float(np.mean(squares / count - mean**2)), 0.0) / (count - 1)
        found = Reference(mean.astype(np.float32), variance, count * spp, count, time.perf_counter() - start)
        tell(f"reference: {found.spp} samples a pixel, noise {found.noise:.2%}")
        if found.noise <= TARGET or found.seconds * (1 + 1 / count) > seconds:
            break
    return found


def crop_of(image: np.ndarray, size: int = CROP) -> tuple[int, int, int, int]:
    """(x, y, width, height) of the square of `size` pixels with the most light in it."""
    grey = image.mean(-1)
    height, width = (min(size, n) for n in grey.shape)
    sums = np.pad(grey.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    window = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    y, x = np.unravel_index(int(window.argmax()), window.shape)
    return int(x), int(y), width, height


def hold_against_stock(subject: Subject, picture: Picture, image: np.ndarray, seconds: float,
                       tell: Callable[[str], None]) -> dict[str, Any]:
    """:func:`.errors.z_test` of the reference's way against stock `volpath` on a crop of `picture` where `image`, the
    reference, is bright, within `seconds`; with ``crop``, ``seconds_per_ray`` of the stock integrator, samples a pixel
    of either side (``stock_spp``, ``spp``), a sentence ``verdict``. A scene that `volpath` refuses has a ``reason`` in
    place of figures."""
    start = time.perf_counter()
    crop = crop_of(image)
    cut = Picture(picture.shrink, crop)
    try:
        ours = Renderer(subject, way(subject), cut)
        stock = Renderer(subject, Point(STOCK, 1, subject.base.max_depth), cut)
        ours(1, FIRST_SEED - 1)  # compiles
        per_sample, _ = _rates(stock)
        left = seconds - (time.perf_counter() - start)
        spp = max(1, min(int(0.7 * left / 16 / per_sample), (1 << 18) // stock.pixels))
        pictures: tuple[list, list] = ([], [])
        share = 0.0
        while len(pictures[0]) < 4 or time.perf_counter() - start + share < seconds:
            began = time.perf_counter()
            for group, render, samples in zip(pictures, (ours, stock), (max(1, spp // 4), spp), strict=True):
                group.append(render(samples, FIRST_SEED + 500 + len(group))[0])
            share = time.perf_counter() - began
            tell(f"reference against stock volpath: {len(pictures[1]) * spp} samples a pixel")
        found: dict[str, Any] = errors.z_test(*pictures)
    except (MiNtfError, RuntimeError) as error:
        return {"reason": str(error), "verdict": f"Stock volpath could not be held against it: {error}",
                "seconds": time.perf_counter() - start}
    n = len(pictures[0])
    found |= {"crop": list(crop), "seconds_per_ray": per_sample / stock.pixels, "spp": n * max(1, spp // 4),
              "stock_spp": n * spp, "seconds": time.perf_counter() - start}
    return found | {"verdict": verdict(found)}


def verdict(found: dict[str, Any]) -> str:
    """What a z-test says, a sentence."""
    figures = (f"their means differ by {found['difference']:+.2%} ± {found['sigma']:.2%} (z {found['z']:.1f}, "
               f"p {found['p']:.2g})")
    where = f"Against stock volpath on {found['crop'][2]}×{found['crop'][3]} pixels, {found['stock_spp']} samples each"
    if found["sigma"] > 0.02:
        return f"{where}: {figures}; too noisy to tell differences below {2 * found['sigma']:.0%}."
    if found["p"] > 0.05:
        return f"{where}: {figures}; no difference is found."
    if found["p"] > 0.01:
        return f"{where}: {figures}; a difference is likely."
    return f"{where}: {figures}; the renderer itself is off by about that."


def find_mesh(subject: Subject) -> Path | None:
    """``reference_LIGHT.exr`` beside the scene, LIGHT the value of its ``$light``: so shipped scenes have it."""
    text = subject.path.read_text(encoding="utf-8", errors="replace")
    default = re.search(r'<default\s+name="light"\s+value="([^"]*)"', text)
    light = subject.parameters.get("light") or (default.group(1) if default else "")
    path = subject.path.parent / f"reference_{light}.exr"
    return path if light and path.is_file() else None


def mesh(subject: Subject, path: Path, picture: Picture, shape: tuple[int, ...], seconds: float) -> Reference:
    """The picture of an EXR file, or of the mesh scene in an XML file, rendered by its own integrator for `seconds`.
    `shape`: of the study's pictures, (h, w, …). Raises MiNtfError where a file is missing or of another shape."""
    if not path.is_file():
        raise MiNtfError(f"reference {path} does not exist; give an EXR picture or the XML file of a mesh scene")
    if path.suffix.lower() == ".xml":
        return _traced(subject, path, picture, seconds)
    image = read_image(path)[..., :3]
    block = image.shape[0] // shape[0]
    if not block or image.shape[:2] != (block * shape[0], block * shape[1]):
        raise MiNtfError(f"reference {path} has {image.shape[1]}×{image.shape[0]} pixels, the study's pictures "
                         f"{shape[1]}×{shape[0]}; give one of a whole multiple of them")
    image = image.reshape(shape[0], block, shape[1], block, 3).mean((1, 3))
    return Reference(image, 0.0, 0, 1, 0.0, f"{path.name}, whose own noise is not known")


def _traced(subject: Subject, path: Path, picture: Picture, seconds: float) -> Reference:
    start = time.perf_counter()

    def change(node) -> None:
        if node.type == mi.ObjectType.Film:
            resize(node.props, picture)

    scene = changed.load(path, subject.parameters, change, strict=False)
    integrator, spp = scene.integrator(), 16
    images: list[np.ndarray] = []
    seed: Any
    while len(images) < 4 or time.perf_counter() - start < seconds:
        seed = FIRST_SEED + len(images)
        images.append(colours(mi.render(scene, integrator=integrator, seed=seed, spp=spp)))
    a = np.stack(images)
    variance = float(a.var(0, ddof=1).mean()) / len(a)
    return Reference(a.mean(0), variance, spp * len(a), len(a), time.perf_counter() - start,
                     f"{path.name} by {integrator.class_name()}, {spp * len(a)} samples a pixel")
