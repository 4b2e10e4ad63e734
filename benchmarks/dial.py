"""Measurements of the limits of the integrator ``nrf`` on the shipped scenes: do pictures keep to them, and how fast?

    python -m benchmarks.dial error  [--scenes statue globe …] [--lights point sky …] [--size 128] [--spp 4]
    python -m benchmarks.dial noise  …
    python -m benchmarks.dial time   …
    python -m benchmarks.dial effects …
    python -m benchmarks.dial stock  …

``error``  `max_error` 2 % with ``auto`` beside every fixed choice: methods, and of environments the number of lights.
           Seconds of one picture and of twenty (the first, the second and 18 times a further one), maps and atlases
           made in the first, kernels compiled; error is to `raymarch` with the same seeds, or bias alone where light is
           drawn at random.
``noise``  `noise_threshold` beside the noise of the picture against one of `TRUTH` samples a pixel.
``time``   `time_budget` beside the seconds that it took, and the error, noise included, beside that of the best fixed
           method in the same time.
``effects``  `max_error` 2 % of pictures with light of up to `DEPTH` edges: the error of all that was left out, and the
           seconds beside those of the same method without anything left out.
``stock``  the first of 1, 2, 3, 4, 6, 8, … samples a pixel with 2 % of relative RMSE, kernels compiled and maps made
           anew, beside stock ``volpath`` of single scattering, whose seconds are reckoned from its noise: it falls by
           1/√N.

One line of JSON a case.
"""

import argparse
import itertools
import json
import math
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core.variants import VARIANTS
from mi_ntf.render.maps import map_cache

from .photographs import field_ball

SCENES = Path(__file__).parents[1] / "scenes"
NAMES = ("statue", "globe", "knot", "cloud", "skull")
LIGHTS = ("point", "directional", "env", "sky", "area")
LIMIT, FRAMES = 0.02, (1, 20)
THRESHOLDS = (0.1, 0.03, 0.01)
BUDGETS, WARM = (5.0, 20.0), 2.0
TRUTH, STOCK, MORE, DEPTH = 4096, 8, 7, 6
FIXED: list[dict[str, Any]] = [
    {"visibility": "raymarch"}, {"visibility": "transmittance_atlas"}, {"visibility": "neural_transmittance"},
    {"visibility": "transmittance_map"},
    {"visibility": "transmittance_map", "map_resolution": 256, "map_components": 2}]
OF_SKIES: list[dict[str, Any]] = [
    *({"visibility": "raymarch", "environment_lights": n} for n in (512, 128)),
    *({"visibility": "transmittance_atlas", "environment_lights": n} for n in (512, 256, 128)),
    *({"visibility": "neural_transmittance", "environment_lights": n} for n in (256, 128)),
    {"visibility": "transmittance_map", "environment_lights": 128}]
"""Where an environment's lights can be fewer. The first of both is the reference."""
OF_DRAWN: list[dict[str, Any]] = [
    *({"visibility": "transmittance_atlas", "light_samples": n} for n in (2, 8, 32)),
    {"visibility": "transmittance_atlas", "light_samples": 2, "samples": 128}]
"""Where many samples are taken in any case. The last suits smoke, which has no skins to be stepped over."""


def emitter(light: str, name: str, center: np.ndarray, radius: float) -> dict[str, Any]:
    """Mitsuba dict of one of `LIGHTS`, as bright and where the scene's own point light is; `sky`: a sun of half a
    degree. The world of ``skull`` is upside down."""
    up = -1.0 if name == "skull" else 1.0
    away = np.array([1.4, 1.8 * up, 2.7 if name != "skull" else -2.0])
    away /= np.linalg.norm(away)
    place, distance = center + 3.2 * radius * away, 3.2 * radius
    power = math.pi * distance**2
    if light == "point":
        return {"type": "point", "position": place.tolist(), "intensity": power}
    if light == "directional":
        return {"type": "directional", "direction": (-away).tolist(), "irradiance": math.pi}
    if light == "env":
        return {"type": "envmap", "filename": str(SCENES / "common" / "env.exr")}
    if light == "area":
        size = 0.3 * radius
        return {"type": "sphere", "center": place.tolist(), "radius": size,
                "light": {"type": "area", "radiance": power / (math.pi * size**2)}}
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], -90 * up)
    return {"type": "sunsky", "sun_direction": away.tolist(), "to_world": upright}


def scene(name: str, light: str, size: int, spp: int):
    """A shipped scene by its own camera under one of `LIGHTS`."""
    path = SCENES / name
    loaded = mi.load_file(str(path / "scene.xml"), res=str(size), spp=str(spp))
    ball = field_ball(path / "field.safetensors")
    center, radius = np.array(ball["center"], float), float(ball["radius"])
    return mi.load_dict({"type": "scene", "sensor": loaded.sensors()[0], "ball": ball,
                         "light": emitter(light, name, center, radius)})


def integrator(**options):
    """``nrf`` without the emitters in the picture."""
    return mi.load_dict({"type": "nrf", "hide_emitters": True, **options})


def picture(loaded, nrf, seed: Any = 0, spp: int = 0) -> tuple[np.ndarray, float]:
    """(h, w, 3) and its seconds."""
    dr.sync_thread()
    start = time.perf_counter()
    image = np.array(mi.render(loaded, integrator=nrf, seed=seed, spp=spp), np.float64)[..., :3]
    return image, time.perf_counter() - start


def relative(image: np.ndarray, truth: np.ndarray) -> float:
    """Relative RMSE."""
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


def frames(loaded, options: dict[str, Any]) -> tuple[np.ndarray, list[float], Any]:
    """Two pictures (2, h, w, 3), seconds of the first, the second and a further one, maps made anew in the first and
    kernels compiled before, and the integrator."""
    with map_cache.in_memory():
        picture(loaded, integrator(**options), 9, 0 if "max_error" in options else 1)
        map_cache.forget()
        nrf = integrator(**options)
        images, seconds = zip(*(picture(loaded, nrf, seed) for seed in (0, 1)), strict=True)
        further = [picture(loaded, nrf, seed)[1] for seed in range(2, MORE if seconds[1] < 1 else 3)]
    return np.stack(images), [*seconds, float(np.median(further))], nrf


def off(images: np.ndarray, truth: np.ndarray, drawn: bool) -> float:
    """Relative RMSE of pictures (2, h, w, 3) to others by the same seeds; `drawn`: of what both have in common alone,
    since light that is drawn makes noise that is each one's own."""
    one, other = images - truth
    square = float((one * other).mean()) if drawn else float((one**2 + other**2).mean()) / 2
    return math.sqrt(max(square, 0.0) / float((truth[0] * truth[1]).mean()))


def error_case(name: str, light: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Rows of `FRAMES`."""
    loaded, fixed, truth = scene(name, light, size, spp), [], None
    for options in OF_SKIES if light in ("env", "sky") else FIXED:
        images, seconds, _ = frames(loaded, options)
        truth = images if truth is None else truth
        fixed.append((options, off(images, truth, light == "area"), seconds))
    assert truth is not None
    rows = []
    for number in FRAMES:
        images, seconds, nrf = frames(loaded, {"max_error": LIMIT, "frames": number})
        best = min((f for f in fixed if f[1] <= LIMIT), key=lambda f: total(f[2], number))
        taken = [t["name"] for t in nrf.achieved["trials"] if t["taken"]]
        rows.append({
            "scene": name, "light": light, "frames": number, "error": off(images, truth, light == "area"),
            "predicted": nrf.achieved["predicted"], "taken": taken[-1] if taken else nrf.achieved["visibility"],
            "seconds": total(seconds, number), "best": best[0], "best_seconds": total(best[2], number),
            "march_seconds": total(fixed[0][2], number)})
    return rows


def total(seconds: list[float], number: int) -> float:
    """Return the seconds of so many pictures."""
    first, second, further = seconds
    return first if number == 1 else first + second + (number - 2) * further


def noise_case(name: str, light: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Rows of `THRESHOLDS`: the noise found, and |I − truth| over √truth as the threshold counts, less the truth's own,
    which its halves tell. All by the march, or what methods differ by would count as noise."""
    loaded, rows = scene(name, light, size, spp), []
    halves = [picture(loaded, integrator(visibility="raymarch"), 100 + k, TRUTH // 2)[0] for k in range(2)]
    truth = np.mean(halves, 0)
    scale = np.sqrt(np.maximum(truth.sum(-1), 0)).sum()
    own = np.abs(halves[0] - halves[1]).sum() / 2 / scale
    for threshold in THRESHOLDS:
        nrf = integrator(visibility="raymarch", noise_threshold=threshold)
        image, seconds = picture(loaded, nrf, 1)
        off = math.sqrt(max((np.abs(image - truth).sum() / scale) ** 2 - own**2, 0.0))
        rows.append({"scene": name, "light": light, "threshold": threshold, "found": nrf.achieved["noise"],
                     "noise": off, "spp": nrf.achieved["spp"], "seconds": seconds})
    return rows


def time_case(name: str, light: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Rows of `BUDGETS`; errors against `raymarch` of many samples."""
    loaded, rows = scene(name, light, size, spp), []
    truth = picture(loaded, integrator(visibility="raymarch"), 100, 64)[0]
    for budget in BUDGETS:
        found = []
        for options in ({}, *({"visibility": v} for v in ("raymarch", "transmittance_atlas", "transmittance_map"))):
            with map_cache.in_memory():
                picture(loaded, integrator(time_budget=WARM, **options), 9)
                map_cache.forget()
                nrf = integrator(time_budget=budget, **options)
                image, seconds = picture(loaded, nrf, 1)
            found.append((relative(image, truth), seconds, nrf.achieved["spp"], nrf.achieved["visibility"]))
        best = min(found[1:], key=lambda f: f[0])
        rows.append({"scene": name, "light": light, "budget": budget, "seconds": found[0][1], "error": found[0][0],
                     "spp": found[0][2], "taken": found[0][3], "best": best[3], "best_error": best[0]})
    return rows


def effects_case(name: str, light: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Return a row: the error of all that was left out, and the seconds with and without it."""
    loaded = scene(name, light, size, spp)
    truth, march, _ = frames(loaded, {"visibility": "raymarch", "max_depth": DEPTH})
    images, seconds, nrf = frames(loaded, {"max_error": LIMIT, "max_depth": DEPTH})
    _, whole, _ = frames(loaded, {"visibility": nrf.achieved["visibility"], "max_depth": DEPTH})
    taken = [t["name"] for t in nrf.achieved["trials"] if t["taken"]]
    return [{"scene": name, "light": light, "error": off(images, truth, light == "area"), "taken": taken,
             "seconds": seconds[0], "whole_seconds": whole[0], "ratio": whole[0] / seconds[0],
             "march_seconds": march[0]}]


def stock_case(name: str, light: str, size: int, spp: int) -> list[dict[str, Any]]:
    """Return a row for the fastest method; `spp` is not read."""
    loaded = scene(name, light, size, 1)
    skies = light in ("env", "sky")
    march = integrator(visibility="raymarch", light_samples=8 if skies else 0)
    some = [picture(loaded, march, 100 + k, 16 if skies else 256)[0] for k in range(4)]
    truth = np.mean(some, 0)
    own = relative(np.stack(some), truth) / math.sqrt(len(some) - 1)  # the truth's, which counts as no one else's
    stock = mi.load_dict({"type": "volpath", "max_depth": 2, "hide_emitters": True})
    picture(loaded, stock, 9, 1)  # compiles
    images, seconds = zip(*(picture(loaded, stock, seed, STOCK) for seed in (0, 1)), strict=True)
    noise = relative(images[0], images[1]) / math.sqrt(2)
    best: tuple[float, dict[str, Any], int, float] = (math.inf, {}, 0, 0.0)
    for options in [*OF_DRAWN, OF_SKIES[3]] if skies else [FIXED[0], FIXED[3], {"samples": 128} | FIXED[0]]:
        nrf = integrator(**options)
        picture(loaded, nrf, 9, 1)
        for samples in sorted({1} | {n << k for n in (2, 3) for k in range(10)}):
            with map_cache.in_memory():
                image, took = picture(loaded, nrf, 1, samples)
            error = math.sqrt(max(relative(image, truth) ** 2 - own**2, 0.0))
            if took > best[0] or error <= LIMIT:
                break
        if took < best[0] and error <= LIMIT:
            best = took, options, samples, error
    reckoned = min(seconds) * (noise / LIMIT) ** 2
    return [{"scene": name, "light": light, "seconds": best[0], "options": best[1], "spp": best[2], "error": best[3],
             "stock_noise": noise, "stock_spp": STOCK, "stock_seconds": min(seconds), "reckoned": reckoned,
             "ratio": reckoned / best[0]}]


CASES = {"error": error_case, "noise": noise_case, "time": time_case, "effects": effects_case,
         "stock": stock_case}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dial")
    parser.add_argument("what", choices=CASES)
    parser.add_argument("--scenes", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--lights", nargs="+", default=LIGHTS, choices=LIGHTS)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--spp", type=int, default=4)
    args = parser.parse_args()
    mi.set_variant(*VARIANTS)
    from mi_ntf.render import register

    register()
    for name, light in itertools.product(args.scenes, args.lights):
        for row in CASES[args.what](name, light, args.size, args.spp):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
