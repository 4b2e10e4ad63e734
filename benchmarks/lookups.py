"""Time and error of lookups compared with the march, on the shipped scenes, beyond :mod:`benchmarks.bench`.

    python -m benchmarks.lookups loop   [--scenes statue globe …] [--size 192] [--spp 8]
    python -m benchmarks.lookups whole  …
    python -m benchmarks.lookups drawn  …
    python -m benchmarks.lookups floor  …
    python -m benchmarks.lookups bounces --size 320 --spp 16

``loop``   nanoseconds of τ at a seen point, towards a direction of its own or the same lights as its neighbours.
``whole``  a picture under the demo's environment, kernels compiled and atlases made anew; error to `raymarch`.
``drawn``  8 lights drawn for each point, of the environment and of an area light: time to equal noise.
``floor``  the field's shadow on a floor under an ``ntf`` around the environment, by stock ``path``: the median of three
           pictures of 256 samples; error of the mean of all, of the picture and relative to the shadow in it.
``bounces``  three bounces of ``examples/three_fields.py``, atlases at hand: seconds and brightness.
             The script's own size is 320, with 16 samples.

One line of JSON a scene. Medians; both sides alternate.
"""

import argparse
import json
import os
import runpy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core.variants import VARIANTS
from mi_ntf.infer.visibility.method import Options
from mi_ntf.render.maps import building, map_cache
from mi_ntf.render.scene.media import find_media

from . import dial, loops
from .photographs import field_ball

METHODS = ("raymarch", "transmittance_atlas", "neural_transmittance")
LIGHTS, DRAWN, FLOOR_SPP, ROUNDS = 64, 8, 256, 3


def loop(name: str, size: int, spp: int) -> dict[str, Any]:
    """`size` and `spp` are not read."""
    medium = find_media(dial.scene(name, "point", 16, 1))[0]
    toward = np.random.default_rng(0).normal(size=(LIGHTS, 3))
    lights = loops.table_of(toward / np.linalg.norm(toward, axis=1, keepdims=True))
    x = loops.seen_points(medium).x
    options = Options(2 / loops.SAMPLES)
    built: dict[str, Any] = {v: building.build(v, medium, lights, options) for v in METHODS[:2]}
    jobs: dict[str, Any] = {f"random {v}": (lambda m=m: _towards_own(m, x)) for v, m in built.items()}
    jobs |= {f"same {v}": (lambda m=m: loops.look_up(m, lights, x)) for v, m in built.items()}
    ns = {k: 1e9 * t / (LIGHTS * dr.width(x[0])) for k, t in loops.seconds(jobs, 7).items()}
    ratio = {way: ns[f"{way} {METHODS[0]}"] / ns[f"{way} {METHODS[1]}"] for way in ("random", "same")}
    return {"scene": name, "ns": ns, "ratio": ratio}


def _towards_own(method, x):
    """Σ of τ at `x` towards `LIGHTS` directions of each point's own."""
    n, count = dr.width(x[0]), dr.opaque(mi.UInt32, LIGHTS)

    def body(i, total):
        bits = mi.sample_tea_32(dr.arange(mi.UInt32, n), i)
        u = mi.Point2f(*(mi.Float(b >> 8) * 2**-24 for b in bits))
        wi = tuple(mi.warp.square_to_uniform_sphere(u))
        return i + 1, total + method.tau(x, wi, mi.Float(dr.inf), i, mi.Bool(True))

    state: Any = (dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n))
    return dr.while_loop(state=state, cond=lambda i, total: i < count, body=body, label="own directions")[1]


def whole(name: str, size: int, spp: int) -> dict[str, Any]:
    """Render one picture by each method; return its seconds and its error to the march."""
    small, loaded, found = dial.scene(name, "env", 16, 1), dial.scene(name, "env", size, spp), {}
    with map_cache.in_memory():
        for method in METHODS:
            nrf = dial.integrator(visibility=method)
            dial.picture(small, nrf)
            map_cache.forget()
            found[method] = dial.picture(loaded, nrf)
    truth, march = found[METHODS[0]]
    return {"scene": name, "size": size, "spp": spp} | {
        method: {"seconds": took, "ratio": march / took, "error": dial.relative(image, truth),
                 "mean": image.mean() / truth.mean() - 1} for method, (image, took) in found.items()}


def drawn(name: str, size: int, spp: int) -> dict[str, Any]:
    """Time to equal noise over that of the march, atlas at hand: seconds × variance of three seeds."""
    row: dict[str, Any] = {"scene": name, "size": size, "spp": spp}
    for light in ("env", "area"):
        loaded, found = dial.scene(name, light, size, spp), {}
        with map_cache.in_memory():
            for method in METHODS:
                nrf = dial.integrator(visibility=method, light_samples=DRAWN)
                dial.picture(loaded, nrf, 9)
                images, seconds = zip(*(dial.picture(loaded, nrf, seed) for seed in range(ROUNDS)), strict=True)
                found[method] = float(np.median(seconds)), float(np.var(images, 0, ddof=1).mean()), np.mean(images)
        took, variance, mean = found[METHODS[0]]
        row[light] = {m: {"seconds": t, "equal_noise": t * v / (took * variance), "mean": b / mean - 1}
                      for m, (t, v, b) in found.items()}
    return row


def floor(name: str, size: int, spp: int) -> dict[str, Any]:
    """`spp` is not read."""
    path, scenes = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True}), {}
    for method in (*METHODS[:2], ""):
        scenes[method] = _floor_scene(name, method, size)
        dial.picture(scenes[method], path, 9, FLOOR_SPP)
    taken: dict[str, list] = {method: [] for method in scenes}
    for seed in range(ROUNDS):
        for method, loaded in scenes.items():
            taken[method].append(dial.picture(loaded, path, seed, FLOOR_SPP))
    march, atlas, bare = (np.mean([image for image, _ in taken[method]], 0) for method in scenes)
    seconds = {method or "no field": float(np.median([t for _, t in some])) for method, some in taken.items()}
    off = np.sqrt(((atlas - march) ** 2).mean())
    return {"scene": name, "seconds": seconds, "ratio": seconds[METHODS[1]] / seconds[METHODS[0]],
            "error": dial.relative(atlas, march), "error_of_shadow": off / np.sqrt(((bare - march) ** 2).mean())}


def _floor_scene(name: str, method: str, size: int):
    """A floor below what is dense of the field, seen without the field; "": without its shadow."""
    file = str(dial.SCENES / name / "field.safetensors")
    ball = field_ball(dial.SCENES / name / "field.safetensors")
    center, radius, up = np.array(ball["center"], float), float(ball["radius"]), -1.0 if name == "skull" else 1.0
    low, high = find_media(mi.load_dict({"type": "scene", "ball": ball}))[0].field.grid.bounds
    foot = center + np.array([0, radius * (low[1] if up > 0 else high[1]), 0])
    place = mi.ScalarTransform4f
    eye = (center + radius * np.array([1.5, 2.2 * up, 2.6])).tolist()
    above, foot = (foot + np.array([0, up, 0])).tolist(), foot.tolist()
    sky: dict[str, Any] = {"type": "envmap", "filename": str(dial.SCENES / "common" / "env.exr")}
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": place().look_at(eye, foot, [0, up, 0]),
                   "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"},
                  "to_world": place().look_at(foot, above, [0, 0, 1]).scale(4 * radius)},
        "light": {"type": "ntf", "visibility": method, "sky": sky, "field": {"type": "nrf", "filename": file}}
        if method else sky})


def bounces(name: str, size: int, spp: int) -> dict[str, Any]:
    """`name` is not read: all three fields stand in the picture."""
    load = runpy.run_path(str(dial.SCENES.parent / "examples" / "three_fields.py"))["load"]
    scenes: dict[str, Any] = {method: load(size, spp, 4, method) for method in METHODS[:2]}
    taken: dict[str, list] = {method: [] for method in scenes}
    with map_cache.in_memory():
        for seed in range(ROUNDS + 1):
            for method, loaded in scenes.items():
                taken[method].append(dial.picture(loaded, loaded.integrator(), seed))
    march, atlas = (float(np.median([t for _, t in some[1:]])) for some in taken.values())
    lit, looked_up = (np.mean([image for image, _ in some]) for some in taken.values())
    return {"size": size, "spp": spp, "seconds": {METHODS[0]: march, METHODS[1]: atlas}, "ratio": atlas / march,
            "mean": looked_up / lit - 1}


CASES = {"loop": loop, "whole": whole, "drawn": drawn, "floor": floor, "bounces": bounces}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lookups")
    parser.add_argument("what", choices=CASES)
    parser.add_argument("--scenes", nargs="+", default=("statue",), choices=dial.NAMES)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--spp", type=int, default=8)
    args = parser.parse_args()
    os.environ.setdefault("MI_NTF_CACHE", "memory")
    mi.set_variant(*VARIANTS)
    from mi_ntf.render import register

    register()
    for name in args.scenes:
        print(json.dumps(CASES[args.what](name, args.size, args.spp), default=float), flush=True)


if __name__ == "__main__":
    main()
