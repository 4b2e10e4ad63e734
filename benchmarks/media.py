"""Mitsuba's own scenes of participating media: ``nrf`` in place of ``volpath``, ``results/media.json``.

    git clone https://github.com/mitsuba-renderer/mitsuba-data
    python -m benchmarks.media [--data mitsuba-data] [--scenes test_homo_null_envmap_volpath …] [--size 64] [--parts 16]

The scenes stand in ``tests/scenes/participating_media`` of Mitsuba's test data. Each is rendered at its own depth and
with single scattering, by `volpath` and by each visibility method, in independent pictures that allow for a z-test. A
row has the ratio of both means and its standard error, the largest difference of blocks of 8² pixels, and the verdict
of the test. References stay in the user's cache. Scenes that `nrf` refuses are listed with its sentence.
"""

import re
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.stats import t as student

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render import user_cache

from . import record
from .dial import Options
from .scenes import picture

FOLDER = Path("tests", "scenes", "participating_media")
CHOICES: dict[str, Options] = {
    "auto": {}, "raymarch": {"visibility": "raymarch", "light_samples": 4},
    "transmittance_atlas": {"visibility": "transmittance_atlas", "light_samples": 4}}
"""Choices of the integrator; those with sampled lights have the noise of `volpath` and no error of an environment's
cells."""
STOCK_SAMPLES, SAMPLES, BLOCK = 1024, 32, 8
"""Samples a pixel of all pictures of `volpath` together, and of `nrf`; pixels along a block."""
SIGNIFICANCE, PASSING = 0.01, 0.9975
"""Chance that equal renderers fail, divided among the blocks; fraction of the blocks that have to pass."""
REFUSED = re.compile(r"another sigma_t|no nrf medium")
"""Sentences about scenes whose media one transmittance cannot hold, or that have none."""


def names(folder: Path) -> list[str]:
    """Return the names of the scenes in `folder`. Raises MiNtfError if there are none."""
    scenes = sorted(path.stem for path in folder.glob("test_*.xml"))
    if not scenes:
        raise MiNtfError(f"{folder} holds no scenes; clone https://github.com/mitsuba-renderer/mitsuba-data and name "
                         "its folder")
    return scenes


def depth_of(loaded: Any) -> int:
    """Return `max_depth` of the integrator of a scene; -1: none."""
    match = re.search(r"max_depth = (-?\d+)", str(loaded.integrator()))
    return int(match[1]) if match else -1


def pictures(loaded: Any, nrf: Any, parts: int, samples: int) -> np.ndarray:
    """Return `parts` pictures (parts, h, w, 3) of `samples` samples a pixel in all."""
    return np.stack([picture(loaded, nrf, 1000 * k + 7, max(samples // parts, 1))[0] for k in range(parts)])


def reference(path: Path, size: int, depth: int, parts: int, samples: int) -> np.ndarray:
    """Return pictures of ``volpath``, kept in the user's cache."""
    name = user_cache.key("media", path.name, path.read_bytes(), size, depth, parts, samples, mi.__version__)

    def make() -> dict[str, np.ndarray]:
        stock = mi.load_dict({"type": "volpath", "max_depth": depth})
        return {"parts": pictures(scene(path, size), stock, parts, samples)}

    with user_cache.switched("on"):
        return user_cache.cached("references", name, make)["parts"]


def scene(path: Path, size: int) -> Any:
    """Return a scene with `size`² pixels."""
    return mi.load_file(str(path), integrator="volpath", res=str(size), spp="1")


def blocks(images: np.ndarray, size: int) -> np.ndarray:
    """Return the means of blocks of `size`² pixels of pictures (n, h, w, 3)."""
    n, h, w, c = images.shape
    rows, columns = h // size, w // size
    part = images[:, : rows * size, : columns * size].reshape(n, rows, size, columns, size, c)
    return np.asarray(part.mean(axis=(2, 4)))


def probability(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the two-sided probability of the difference of means under equal means, by Welch's test over axis 0."""
    va, vb = a.var(0, ddof=1) / len(a), b.var(0, ddof=1) / len(b)
    variance = np.maximum(va + vb, 1e-30)
    freedom = variance**2 / np.maximum(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-60)
    difference = np.abs(a.mean(0) - b.mean(0))
    result = 2 * student.sf(difference / np.sqrt(variance), np.clip(freedom, 1, len(a) + len(b) - 2))
    return np.where(difference < 1e-3 * b.mean(), 1.0, result)


def compared(ours: np.ndarray, theirs: np.ndarray, size: int = BLOCK) -> dict[str, Any]:
    """Return ratio and error of the means, the largest difference of blocks, and the verdict of the z-test."""
    mean, other = (images.mean(axis=(1, 2, 3)) for images in (ours, theirs))
    error = np.sqrt(mean.var(ddof=1) / len(mean) / mean.mean() ** 2 + other.var(ddof=1) / len(other) / other.mean()**2)
    a, b = blocks(ours, size), blocks(theirs, size)
    p = probability(a, b)
    of_all = float(probability(mean, other))
    passing = float((p >= 1 - (1 - SIGNIFICANCE) ** (1 / p.size)).mean())
    grey, truth = a.mean(0).sum(-1), b.mean(0).sum(-1)
    worst = float((np.abs(grey - truth) / np.maximum(truth, 0.2 * truth.max())).max())
    return {"ratio": float(mean.mean() / other.mean()), "standard_error": float(error), "worst_block": worst,
            "passing": passing, "p_of_means": of_all,
            "passes": passing >= PASSING and of_all >= SIGNIFICANCE / 10}


def rows(path: Path, size: int, parts: int, samples: int, stock_samples: int,
         methods: tuple[str, ...] = tuple(CHOICES)) -> list[dict[str, Any]]:
    """Return a row for each depth and method of a scene; one with the sentence where it is refused."""
    result: list[dict[str, Any]] = []
    own = depth_of(scene(path, size))
    for depth in dict.fromkeys((2, own)):
        theirs: np.ndarray | None = None
        for method in methods:
            loaded = scene(path, size)
            nrf = mi.load_dict({"type": "nrf", "max_depth": depth, **CHOICES[method]})
            try:
                picture(loaded, nrf, 9, 1)
            except (MiNtfError, RuntimeError) as error:
                if REFUSED.search(str(error)):
                    return [{"scene": path.stem, "refused": str(error).splitlines()[-1]}]
                raise
            theirs = reference(path, size, depth, parts, stock_samples) if theirs is None else theirs
            start = time.perf_counter()
            row = compared(pictures(loaded, nrf, parts, samples), theirs, min(BLOCK, size // 4))
            result.append({"scene": path.stem, "depth": depth, "options": CHOICES[method], **row,
                           "seconds": time.perf_counter() - start})
            verdict = "passes" if row["passes"] else "FAILS"
            print(f"{path.stem} depth {depth} {method}: {row['ratio']:.4f} ± {row['standard_error']:.4f}, worst block "
                  f"{row['worst_block']:.1%}, {verdict}, {result[-1]['seconds']:.0f} s", flush=True)
    return result


def main() -> None:
    """Measure and write the results."""
    options = record.options(__doc__, ("--data", {"type": Path, "default": Path("mitsuba-data")}),
                             ("--scenes", {"nargs": "+", "default": []}), ("--size", {"type": int, "default": 64}),
                             ("--parts", {"type": int, "default": 16}),
                             ("--methods", {"nargs": "+", "default": list(CHOICES), "choices": CHOICES}))
    size, parts, samples, stock = ((16, 4, 4, 16) if options.quick
                                   else (options.size, options.parts, SAMPLES, STOCK_SAMPLES))
    record.prepare("memory")
    start = time.perf_counter()
    folder = options.data / FOLDER
    results = [row for name in options.scenes or names(folder)
             for row in rows(folder / f"{name}.xml", size, parts, samples, stock, tuple(options.methods))]
    record.write("media", {"size": size, "rows": results}, start, options.out)


if __name__ == "__main__":
    main()
