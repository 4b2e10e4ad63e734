"""Errors and seconds that the limits of the integrator ``nrf`` keep to, on shipped scenes: ``results/dial.json``.

    python -m benchmarks.dial [CASE …] [--scenes statue globe …] [--lights point sky …] [--size 128] [--spp 4]

- ``error``: `max_error` 2 % with ``auto`` beside every fixed choice: methods, and for environments the number of
  lights. Seconds of one picture and of twenty (the first, the second and 18 times a further one), tables made in the
  first, kernels compiled. Errors are to `raymarch` by the same seeds; where light is sampled at random, they are the
  part that two pictures by independent seeds have in common.
- ``noise``: `noise_threshold` beside the noise of the picture against one of `TRUTH` samples a pixel
- ``time``: `time_budget` beside the seconds that it took, and the error, noise included, beside that of the best fixed
  method in the same time
- ``effects``: `max_error` 2 % with paths of up to `DEPTH` edges: the error of all that was left out, and the seconds
  beside those of the same method with nothing left out
- ``stock``: the smallest number of samples with 2 % of relative RMSE, tables made anew, beside stock ``volpath`` of
  single scattering, whose seconds are computed from its noise, which falls by 1/√N

Takes about 40 minutes on two cores.
"""

import itertools
import math
import os
import time
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.render.maps import map_cache

from . import record
from .scenes import LIGHTS, NAMES, integrator, picture, scene

LIMIT, FRAMES = 0.02, (1, 20)
THRESHOLDS = (0.1, 0.03, 0.01)
BUDGETS, WARM = (5.0, 20.0), 2.0
"""Budgets in seconds, and the one of the picture that compiles."""
TRUTH, STOCK, FURTHER, DEPTH = 4096, 8, 7, 6
"""Samples a pixel of references of noise, and of a picture of volpath; pictures of a quick method; edges of a path."""
Options = dict[str, Any]
"""Properties of an integrator."""
Rows = list[dict[str, Any]]
FIXED: list[Options] = [
    {"visibility": "raymarch"}, {"visibility": "transmittance_atlas"}, {"visibility": "neural_transmittance"},
    {"visibility": "transmittance_map"},
    {"visibility": "transmittance_map", "map_resolution": 256, "map_components": 2}]
"""Fixed choices; the first is the reference."""
OF_SKIES: list[Options] = [
    *({"visibility": "raymarch", "environment_lights": n} for n in (512, 128)),
    *({"visibility": "transmittance_atlas", "environment_lights": n} for n in (512, 256, 128)),
    *({"visibility": "neural_transmittance", "environment_lights": n} for n in (256, 128)),
    {"visibility": "transmittance_map", "environment_lights": 128}]
"""Fixed choices for environments, whose lights can be fewer; the first is the reference."""
SAMPLED: list[Options] = [
    *({"visibility": "transmittance_atlas", "light_samples": n} for n in (2, 8, 32)),
    {"visibility": "transmittance_atlas", "light_samples": 2, "samples": 128}]
"""Choices with sampled lights, where many samples a pixel are taken in any case; the last one suits smoke."""


def frames(loaded: Any, options: Options) -> tuple[np.ndarray, list[float], Any]:
    """Return two pictures (2, h, w, 3), the seconds of the first, the second and a further one, and the integrator.

    Tables are made anew in the first picture. Kernels are compiled before.
    """
    with map_cache.in_memory():
        picture(loaded, integrator(**options), 9, 0 if "max_error" in options else 1)
        map_cache.forget()
        nrf = integrator(**options)
        images, seconds = zip(*(picture(loaded, nrf, seed) for seed in (0, 1)), strict=True)
        further = [picture(loaded, nrf, seed)[1] for seed in range(2, FURTHER if seconds[1] < 1 else 3)]
    return np.stack(images), [*seconds, float(np.median(further))], nrf


def error_of(images: np.ndarray, truth: np.ndarray, sampled: bool) -> float:
    """Return the relative RMSE of two pictures (2, h, w, 3) to two others by the same seeds.

    With `sampled`, only errors that both pictures have in common count, since light that is sampled at random makes
    noise that is each picture's own.
    """
    one, other = images - truth
    square = float((one * other).mean()) if sampled else float((one**2 + other**2).mean()) / 2
    return math.sqrt(max(square, 0.0) / float((truth[0] * truth[1]).mean()))


def total(seconds: list[float], number: int) -> float:
    """Return the seconds of so many pictures."""
    first, second, further = seconds
    return first if number == 1 else first + second + (number - 2) * further


def _chosen(nrf: Any) -> list[str]:
    """Return the names of the candidates that an integrator has chosen."""
    return [t["name"] for t in nrf.achieved["trials"] if t["taken"]]


def error_case(name: str, light: str, size: int, spp: int) -> Rows:
    """Return a row for each number of `FRAMES`."""
    loaded, fixed, truth = scene(name, light, size, spp), [], None
    for options in OF_SKIES if light in ("env", "sky") else FIXED:
        images, seconds, _ = frames(loaded, options)
        truth = images if truth is None else truth
        fixed.append((options, error_of(images, truth, light == "area"), seconds))
    assert truth is not None
    rows = []
    for number in FRAMES:
        images, seconds, nrf = frames(loaded, {"max_error": LIMIT, "frames": number})
        best = min((f for f in fixed if f[1] <= LIMIT), key=lambda f: total(f[2], number))
        took, best_took = total(seconds, number), total(best[2], number)
        rows.append({
            "frames": number, "error": error_of(images, truth, light == "area"), "predicted": nrf.achieved["predicted"],
            "chosen": (_chosen(nrf) or [nrf.achieved["visibility"]])[-1], "seconds": took, "best": best[0],
            "best_seconds": best_took, "ratio": took / best_took, "march_seconds": total(fixed[0][2], number)})
    return rows


def noise_case(name: str, light: str, size: int, spp: int) -> Rows:
    """Return a row for each of `THRESHOLDS`: the noise that the integrator reports, and the measured one.

    Noise is |I − truth| over √truth, as the threshold counts it, less that of the truth, which its halves tell. All
    pictures are by the march, since differences between methods would count as noise.
    """
    loaded, rows = scene(name, light, size, spp), []
    halves = [picture(loaded, integrator(visibility="raymarch"), 100 + k, TRUTH // 2)[0] for k in range(2)]
    truth = np.mean(halves, 0)
    scale = np.sqrt(np.maximum(truth.sum(-1), 0)).sum()
    noise_of_truth = np.abs(halves[0] - halves[1]).sum() / 2 / scale
    for threshold in THRESHOLDS:
        nrf = integrator(visibility="raymarch", noise_threshold=threshold)
        image, seconds = picture(loaded, nrf, 1)
        noise = math.sqrt(max((np.abs(image - truth).sum() / scale) ** 2 - noise_of_truth**2, 0.0))
        rows.append({"threshold": threshold, "reported": nrf.achieved["noise"], "noise": noise,
                     "spp": nrf.achieved["spp"], "seconds": seconds})
    return rows


def time_case(name: str, light: str, size: int, spp: int) -> Rows:
    """Return a row for each of `BUDGETS`; errors are to `raymarch` with many samples."""
    loaded, rows = scene(name, light, size, spp), []
    truth = picture(loaded, integrator(visibility="raymarch"), 100, 64)[0]
    for budget in BUDGETS:
        results = []
        for options in ({}, *({"visibility": v} for v in ("raymarch", "transmittance_atlas", "transmittance_map"))):
            with map_cache.in_memory():
                picture(loaded, integrator(time_budget=WARM, **options), 9)
                map_cache.forget()
                nrf = integrator(time_budget=budget, **options)
                image, seconds = picture(loaded, nrf, 1)
            results.append({"error": relative_rmse(image, truth), "seconds": seconds, "spp": nrf.achieved["spp"],
                            "chosen": nrf.achieved["visibility"]})
        best = min(results[1:], key=lambda r: float(r["error"]))
        rows.append({"budget": budget, **results[0], "best": best["chosen"], "best_error": best["error"]})
    return rows


def effects_case(name: str, light: str, size: int, spp: int) -> Rows:
    """Return a row: the error of all that was left out, and the seconds with and without it."""
    loaded = scene(name, light, size, spp)
    truth, march, _ = frames(loaded, {"visibility": "raymarch", "max_depth": DEPTH})
    images, seconds, nrf = frames(loaded, {"max_error": LIMIT, "max_depth": DEPTH})
    _, whole, _ = frames(loaded, {"visibility": nrf.achieved["visibility"], "max_depth": DEPTH})
    return [{"error": error_of(images, truth, light == "area"), "chosen": _chosen(nrf), "seconds": seconds[0],
             "whole_seconds": whole[0], "ratio": whole[0] / seconds[0], "march_seconds": march[0]}]


def to_limit(loaded: Any, choice: Options, truth: np.ndarray, noise_of_truth: float, most: float) -> dict[str, Any]:
    """Return the first picture with an error of `LIMIT` or more seconds than `most`, of growing numbers of samples.

    Maps are made anew in each picture, and kernels are compiled before. `truth` has the relative error
    `noise_of_truth`. The keys are ``seconds``, ``options``, ``spp`` and ``error``.
    """
    nrf = integrator(**choice)
    picture(loaded, nrf, 9, 1)
    for samples in sorted({1} | {n << k for n in (2, 3) for k in range(10)}):
        with map_cache.in_memory():
            image, took = picture(loaded, nrf, 1, samples)
        error = math.sqrt(max(relative_rmse(image, truth) ** 2 - noise_of_truth**2, 0.0))
        if took > most or error <= LIMIT:
            break
    return {"seconds": took, "options": choice, "spp": samples, "error": error}


def stock_case(name: str, light: str, size: int, spp: int) -> Rows:
    """Return a row for the fastest choice; `spp` is ignored."""
    loaded = scene(name, light, size, 1)
    sky = light in ("env", "sky")
    march = integrator(visibility="raymarch", light_samples=8 if sky else 0)
    parts = [picture(loaded, march, 100 + k, 16 if sky else 256)[0] for k in range(4)]
    truth = np.mean(parts, 0)
    noise_of_truth = relative_rmse(np.stack(parts), np.stack([truth] * 4)) / math.sqrt(len(parts) - 1)
    stock = mi.load_dict({"type": "volpath", "max_depth": 2, "hide_emitters": True})
    picture(loaded, stock, 9, 1)  # compiles
    images, seconds = zip(*(picture(loaded, stock, seed, STOCK) for seed in (0, 1)), strict=True)
    noise = relative_rmse(images[0], images[1]) / math.sqrt(2)
    choices = [*SAMPLED, OF_SKIES[3]] if sky else [FIXED[0], FIXED[3], {"samples": 128} | FIXED[0]]
    best: dict[str, Any] = {"seconds": math.inf}
    for choice in choices:
        row = to_limit(loaded, choice, truth, noise_of_truth, best["seconds"])
        best = row if row["seconds"] < best["seconds"] and row["error"] <= LIMIT else best
    computed = min(seconds) * (noise / LIMIT) ** 2
    return [{**best, "stock_noise": noise, "stock_spp": STOCK, "stock_seconds": min(seconds),
             "computed_seconds": computed, "ratio": computed / best["seconds"]}]


CASES: dict[str, Callable[[str, str, int, int], Rows]] = {
    "error": error_case, "noise": noise_case, "time": time_case, "effects": effects_case, "stock": stock_case}
PLAN = {"error": (NAMES, LIGHTS), "noise": (("statue", "globe"), ("point", "area")),
        "time": (("statue", "cloud"), ("point", "env")), "effects": (("statue", "knot"), ("point", "env")),
        "stock": (("statue", "cloud"), ("point", "env"))}
"""Scenes and lights of each case, unless others are named."""


def main() -> None:
    """Measure and write the results."""
    options = record.options(
        __doc__, ("cases", {"nargs": "*", "metavar": "CASE"}), ("--scenes", {"nargs": "+", "choices": NAMES}),
        ("--lights", {"nargs": "+", "choices": LIGHTS}), ("--size", {"type": int, "default": 128}),
        ("--spp", {"type": int, "default": 4}))
    record.prepare("memory")
    start = time.perf_counter()
    values: dict[str, Rows] = {}
    for case in options.cases or CASES:
        names, lights = PLAN[case]
        pairs = list(itertools.product(options.scenes or names, options.lights or lights))
        values[case] = []
        for name, light in pairs[:1] if options.quick else pairs:
            rows = CASES[case](name, light, options.size, options.spp)
            values[case] += [{"scene": name, "light": light, **row} for row in rows]
            print(f"{time.perf_counter() - start:5.0f} s  {case} {name} {light}", flush=True)
    record.write("dial", {"size": options.size, "spp": options.spp, **values}, start, options.out)
    print(f"load {os.getloadavg()[0]:.2f} at the end")


if __name__ == "__main__":
    main()
