"""Stock smoke to 2 % of error beside ``volpath``, under a lamp and under an environment: ``results/smoke.json``.

    python -m benchmarks.smoke [--lights lamp environment] [--size 128] [--repeats 3] [--truth 16384]

The smoke is a ``heterogeneous`` medium on a grid, scattered once. A row is a choice of the integrator ``nrf``: the
least number of samples with 2 % of relative RMSE, and the seconds of such a picture, its maps made anew and its kernels
compiled. The seconds of ``volpath`` are computed from its noise, which falls by 1/√N. Both are measured in turn.
References are means of `volpath` pictures of ``--truth`` samples, and stay in the user's cache.
"""

import math
import time
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.render import user_cache
from mi_ntf.render.maps import map_cache

from . import record
from .dial import LIMIT, STOCK, Options, to_limit
from .scenes import SCENES, integrator, picture

VOXELS, PARTS, PATIENCE = 64, 16, 60.0
"""Voxels along a side of the smoke; pictures of a reference; seconds after which a choice is given up."""
SETTING = {"scale": 12.0, "albedo": 0.9, "g": 0.5}
"""Extinction of the densest voxel, per half of the smoke's side; albedo; asymmetry of the phase function."""
CHOICES: dict[str, list[Options]] = {
    "lamp": [{"visibility": name} for name in ("raymarch", "transmittance_map", "transmittance_atlas")],
    "environment": [
        {"visibility": "raymarch", "light_samples": 8}, {"visibility": "transmittance_atlas", "light_samples": 8},
        {"visibility": "transmittance_atlas", "light_samples": 32},
        *({"visibility": "transmittance_atlas", "environment_lights": n} for n in (64, 128, 512)),
        *({"visibility": "transmittance_map", "environment_lights": n} for n in (64, 128))]}
"""Light → choices of the integrator."""


def puff(n: int = VOXELS) -> np.ndarray:
    """Return densities (z, y, x) in [0, 1] of a billowing ball of n³ voxels."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    swirl = sum(np.sin(2**k * (3 * x + 1.7 * np.sin(2 * y + k)) + k) * np.cos(2**k * (2.3 * z - 1.3 * y)) / 2**k
                for k in range(3))
    density = np.clip(1.1 - 1.3 * np.sqrt(x * x + y * y + z * z) + 0.3 * swirl, 0, None)
    result: np.ndarray = (density / density.max()).astype(np.float32)
    return result


def scene(light: str, size: int) -> Any:
    """Return the smoke in a cube under a light, with `size`² pixels."""
    upright = mi.ScalarTransform4f()
    emitter = ({"type": "point", "position": [2.0, 3.0, 2.0], "intensity": 30.0} if light == "lamp" else
               {"type": "envmap", "filename": str(SCENES / "common" / "env.exr")})
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(puff()), "to_world": upright.translate(-1).scale(2)}
    medium = {"type": "heterogeneous", "sigma_t": grid, "albedo": SETTING["albedo"], "scale": SETTING["scale"],
              "phase": {"type": "hg", "g": SETTING["g"]}}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    return mi.load_dict({
        "type": "scene", "light": emitter,
        "smoke": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        "sensor": {"type": "perspective", "fov": 36.0, "film": film, "sampler": {"type": "independent"},
                   "to_world": upright.look_at([0.5, 1.0, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])}})


def reference(light: str, size: int, spp: int, stock: Any) -> tuple[np.ndarray, float]:
    """Return the mean of `PARTS` pictures of volpath, `spp` samples in all, and its relative error."""
    name = user_cache.key("smoke", light, size, spp, repr(SETTING), puff(), mi.__version__)

    def make() -> dict[str, np.ndarray]:
        loaded = scene(light, size)
        parts = [picture(loaded, stock, 1000 + k, max(spp // PARTS, 1))[0] for k in range(PARTS)]
        return {"parts": np.stack(parts)}

    with user_cache.switched("on"):
        parts = user_cache.cached("references", name, make)["parts"]
    truth = parts.mean(0)
    return truth, relative_rmse(parts, np.stack([truth] * PARTS)) / math.sqrt(PARTS - 1)


def rows(light: str, size: int, repeats: int, spp: int) -> list[dict[str, Any]]:
    """Return a row for each choice: seconds of both, and their ratio, each the median of measurements in turn."""
    stock = mi.load_dict({"type": "volpath", "max_depth": 2, "hide_emitters": True})
    loaded = scene(light, size)
    truth, error_of_truth = reference(light, size, spp, stock)
    picture(loaded, stock, 9, STOCK)
    result = []
    for choice in CHOICES[light]:
        row = to_limit(loaded, choice, truth, error_of_truth, PATIENCE)
        nrf, ours, theirs = integrator(**choice), [], []
        for seed in range(repeats):
            with map_cache.in_memory():
                ours.append(picture(loaded, nrf, seed, row["spp"])[1])
            image, seconds = picture(loaded, stock, seed, STOCK)
            theirs.append(seconds * (relative_rmse(image, truth) / LIMIT) ** 2)
        result.append({**row, "light": light, "reached": row["error"] <= LIMIT, "error_of_truth": error_of_truth,
                       "seconds": record.spread(ours), "volpath_seconds": record.spread(theirs),
                       "ratio": record.ratio(theirs, ours)})
        print(f"{light} {choice}: {row['spp']} samples, {row['error']:.2%}, {result[-1]['seconds']['median']:.2f} s, "
              f"volpath {result[-1]['volpath_seconds']['median']:.0f} s", flush=True)
    return result


def main() -> None:
    """Measure and write the results."""
    options = record.options(__doc__, ("--lights", {"nargs": "+", "choices": CHOICES, "default": list(CHOICES)}),
                             ("--size", {"type": int, "default": 128}), ("--repeats", {"type": int, "default": 3}),
                             ("--truth", {"type": int, "default": 16384}))
    size, repeats, spp = (24, 1, 1024) if options.quick else (options.size, options.repeats, options.truth)
    record.prepare("memory")
    start = time.perf_counter()
    values = {"size": size, "rows": [row for light in options.lights for row in rows(light, size, repeats, spp)]}
    record.write("smoke", values, start, options.out)


if __name__ == "__main__":
    main()
