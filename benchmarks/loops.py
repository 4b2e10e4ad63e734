"""Costs and errors of lookups beside the march, on shipped scenes: ``results/loops.json``.

    python -m benchmarks.loops [CASE …] [--scenes statue globe …]

- ``loop``: time of the transmittance at a seen point, towards a direction of its own, or towards the lights of all
  points
- ``whole``: a picture under the demo's environment, kernels compiled and tables made anew, and its error to
  ``raymarch``
- ``sampled``: 8 lights sampled at each point, of the environment and of an area light: time to equal noise, tables at
  hand
- ``floor``: shadow of a field on a floor by ``ntf`` around the environment, and stock ``path``; error of mean pictures
- ``bounces``: three bounces of ``examples/three_fields.py``, tables at hand

The methods are measured in turn. Takes about 15 minutes on two cores.
"""

import os
import runpy
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.infer.visibility.method import Options
from mi_ntf.render.maps import building, map_cache
from mi_ntf.render.scene.media import find_media

from . import record, scenes, timing

METHODS = ("raymarch", "transmittance_atlas", "neural_transmittance")
SAMPLED = 8
"""Lights that are sampled at each point."""


@dataclass(frozen=True)
class Sizes:
    """Amounts that are measured.

    - points, lights: of the loops
    - whole: pixels along a side, and samples a pixel, of pictures under the demo's environment
    - sampled: the same of pictures by sampled lights
    - floor: the same of pictures of the floor
    - bounces: the same of the three fields
    - repeats: rounds of pictures; loops have twice as many
    """

    points: int = timing.POINTS
    lights: int = 64
    whole: tuple[int, int] = (256, 4)
    sampled: tuple[int, int] = (192, 8)
    floor: tuple[int, int] = (192, 256)
    bounces: tuple[int, int] = (320, 16)
    repeats: int = 3


FULL = Sizes()
QUICK = Sizes(1 << 8, 2, (24, 1), (16, 2), (24, 4), (16, 1), 2)


def loop(name: str, sizes: Sizes) -> dict[str, Any]:
    """Return nanoseconds per point and light, by kind of direction and by method, and the ratios."""
    medium = find_media(scenes.scene(name, "point", 16, 1))[0]
    directions = np.random.default_rng(0).normal(size=(sizes.lights, 3))
    lights = timing.table_of(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    x = timing.seen_points(medium, sizes.points).x
    work: dict[str, Callable[[], Any]] = {}
    for method in METHODS[:2]:
        built = building.build(method, medium, lights, Options(2 / timing.SAMPLES))
        work[f"random {method}"] = partial(_towards_random, built, x, sizes.lights)
        work[f"same {method}"] = partial(timing.look_up, built, lights, x)
    times = timing.rounds(work, 2 * sizes.repeats)
    scale = 1e9 / (sizes.lights * dr.width(x[0]))
    return {kind: {**{method: record.spread(scale * t for t in times[f"{kind} {method}"]) for method in METHODS[:2]},
                   "ratio": record.ratio(times[f"{kind} {METHODS[0]}"], times[f"{kind} {METHODS[1]}"])}
            for kind in ("random", "same")}


def _towards_random(method: Any, x: Any, lights: int) -> Any:
    """Return the sum of the transmittance at the points `x` towards `lights` random directions of each point."""
    n, count = dr.width(x[0]), dr.opaque(mi.UInt32, lights)

    def body(i: Any, total: Any) -> Any:
        lane: Any = dr.arange(mi.UInt32, n)
        bits = mi.sample_tea_32(lane, i)
        u = mi.Point2f(*(mi.Float(b >> 8) * 2**-24 for b in bits))
        wi = tuple(mi.warp.square_to_uniform_sphere(u))
        return i + 1, total + method.tau(x, wi, mi.Float(dr.inf), i, mi.Bool(True))

    def more(i: Any, total: Any) -> Any:
        return i < count

    state: Any = (dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n))
    return dr.while_loop(state=state, cond=more, body=body, label="random directions")[1]


def _pictures(loaded: dict[str, Any], integrators: dict[str, Any], repeats: int, spp: int = 0, anew: bool = False
              ) -> tuple[dict[str, np.ndarray], dict[str, list[float]]]:
    """Return the pictures (repeats, h, w, 3) and their seconds by method; methods take turns.

    `anew` forgets the tables before each picture; otherwise the first picture, which is left out, has made them.
    """
    images: dict[str, list[np.ndarray]] = {method: [] for method in loaded}
    seconds: dict[str, list[float]] = {method: [] for method in loaded}
    with map_cache.in_memory():
        for seed in range(-1, repeats):
            for method, scene in loaded.items():
                if anew:
                    map_cache.forget()
                image, took = scenes.picture(scene, integrators[method], seed if seed >= 0 else 99, spp)
                if seed >= 0:
                    images[method].append(image)
                    seconds[method].append(took)
    return {method: np.stack(each) for method, each in images.items()}, seconds


def _compared(seconds: dict[str, list[float]]) -> dict[str, dict[str, Any]]:
    """Return the seconds of each method, and how many times faster than the march it is."""
    march = seconds[METHODS[0]]
    return {method: {"seconds": record.spread(each), "ratio": record.ratio(march, each)}
            for method, each in seconds.items()}


def whole(name: str, sizes: Sizes) -> dict[str, Any]:
    """Return seconds, speed-up, relative RMSE and difference of brightness of each method."""
    loaded = scenes.scene(name, "env", *sizes.whole)
    integrators = {method: scenes.integrator(visibility=method) for method in METHODS}
    images, seconds = _pictures(dict.fromkeys(METHODS, loaded), integrators, sizes.repeats, anew=True)
    truth = images[METHODS[0]]
    return {method: {**row, "error": relative_rmse(images[method], truth),
                     "brightness": images[method].mean() / truth.mean() - 1}
            for method, row in _compared(seconds).items()}


def sampled(name: str, sizes: Sizes) -> dict[str, Any]:
    """Return, for both lights, seconds of each method and its time to equal noise over that of the march."""
    lights: dict[str, Any] = {}
    for light in ("env", "area"):
        loaded = scenes.scene(name, light, *sizes.sampled)
        integrators = {method: scenes.integrator(visibility=method, light_samples=SAMPLED) for method in METHODS}
        images, seconds = _pictures(dict.fromkeys(METHODS, loaded), integrators, sizes.repeats)
        noise = {method: float(np.var(each, 0, ddof=1).mean()) for method, each in images.items()}
        march = noise[METHODS[0]]
        lights[light] = {method: {**row, "equal_noise": noise[method] / march / row["ratio"]["median"],
                                  "brightness": images[method].mean() / images[METHODS[0]].mean() - 1}
                         for method, row in _compared(seconds).items()}
    return lights


def floor(name: str, sizes: Sizes) -> dict[str, Any]:
    """Return seconds with and without the field, and the error of the atlas, of the picture and of the shadow alone."""
    size, spp = sizes.floor
    path = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    loaded = {method or "no field": _floor_scene(name, method, size) for method in (*METHODS[:2], "")}
    images, seconds = _pictures(loaded, dict.fromkeys(loaded, path), sizes.repeats, spp)
    march, atlas, bare = (each.mean(0) for each in images.values())
    error = relative_rmse(atlas, march)
    return {**_compared(seconds), "error": error, "error_of_shadow": error / relative_rmse(bare, march),
            "brightness": march.mean() / bare.mean()}


def _floor_scene(name: str, method: str, size: int) -> Any:
    """Return a floor below a field whose shadow is seen, but not the field; without the shadow if `method` is empty."""
    file = scenes.SCENES / name / "field.safetensors"
    ball = scenes.field_ball(file)
    center, radius, up = np.array(ball["center"], float), float(ball["radius"]), -1.0 if name == "skull" else 1.0
    low, high = find_media(mi.load_dict({"type": "scene", "ball": ball}))[0].field.grid.bounds
    foot = center + np.array([0, radius * (low[1] if up > 0 else high[1]), 0])
    place = mi.ScalarTransform4f
    eye = (center + radius * np.array([1.5, 2.2 * up, 2.6])).tolist()
    above, foot = (foot + np.array([0, up, 0])).tolist(), foot.tolist()
    sky: dict[str, Any] = {"type": "envmap", "filename": str(scenes.SCENES / "common" / "env.exr")}
    field = {"type": "ntf", "visibility": method, "sky": sky, "field": {"type": "nrf", "filename": str(file)}}
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": place().look_at(eye, foot, [0, up, 0]),
                   "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"},
                  "to_world": place().look_at(foot, above, [0, 0, 1]).scale(4 * radius)},
        "light": field if method else sky})


def bounces(name: str, sizes: Sizes) -> dict[str, Any]:
    """Return seconds and difference of brightness; `name` is ignored, since all three fields are in the picture."""
    load = runpy.run_path(str(scenes.SCENES.parent / "examples" / "three_fields.py"))["load"]
    loaded = {method: load(*sizes.bounces, 4, method) for method in METHODS[:2]}
    integrators = {method: scene.integrator() for method, scene in loaded.items()}
    images, seconds = _pictures(loaded, integrators, sizes.repeats)
    return _compared(seconds) | {"brightness": images[METHODS[1]].mean() / images[METHODS[0]].mean() - 1}


CASES: dict[str, Callable[[str, Sizes], dict[str, Any]]] = {
    "loop": loop, "whole": whole, "sampled": sampled, "floor": floor, "bounces": bounces}
SCENES = {"loop": ("statue", "globe"), "whole": ("statue", "globe"), "sampled": ("statue", "knot"),
          "floor": ("statue", "knot"), "bounces": ("three_fields",)}
"""Scenes of each case, unless others are named."""


def main() -> None:
    """Measure and write the results."""
    options = record.options(__doc__, ("cases", {"nargs": "*", "metavar": "CASE"}),
                             ("--scenes", {"nargs": "+", "choices": scenes.NAMES}))
    record.prepare("memory")
    start, sizes = time.perf_counter(), QUICK if options.quick else FULL
    values: dict[str, dict[str, Any]] = {}
    for case in options.cases or CASES:
        names = SCENES[case] if case == "bounces" else options.scenes or SCENES[case]
        for name in names[:1] if options.quick else names:
            values.setdefault(case, {})[name] = CASES[case](name, sizes)
            print(f"{time.perf_counter() - start:5.0f} s  {case} {name}")
    record.write("loops", values, start, options.out)
    print(f"load {os.getloadavg()[0]:.2f} at the end")


if __name__ == "__main__":
    main()
