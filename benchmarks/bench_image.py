"""Whole images of the shipped statue under an environment of many lights, by the product as users call it.

    python -m benchmarks.bench_image --size 600 --columns 50 --rows 10 [--repeats 3] [--first]

prints JSON: seconds per render after a small one that compiles (none with --first: the process's first picture), and
the peak memory of the process, which is why measurements of memory run in a process of their own.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core.errors import MiNtfError

SCENES = Path(__file__).parents[1] / "scenes"
SAMPLES = 192


def sky(columns: int, rows: int) -> np.ndarray:
    """The shipped environment, nearest pixels, (rows, columns, 3) linear RGB."""
    image = np.array(mi.Bitmap(str(SCENES / "common" / "env.exr")), np.float32)[..., :3]
    v = ((np.arange(rows) + 0.5) / rows * image.shape[0]).astype(int)
    u = ((np.arange(columns) + 0.5) / columns * image.shape[1]).astype(int)
    return np.ascontiguousarray(image[v][:, u])


def under_sky(size: int, columns: int = 1, rows: int = 1):
    """The statue under `columns` × `rows` texels of the shipped environment."""
    return load(size, {"type": "envmap", "bitmap": mi.Bitmap(sky(columns, rows))})


def load(size: int, light):
    """The statue seen by `size`² pixels. `light`: emitter dict, or a function from the camera's place to one."""
    shipped = SCENES / "statue" / "scene.xml"
    if not shipped.is_file():
        raise MiNtfError(f"{shipped} does not exist; run the benchmark in a checkout, on its scenes/")
    scene = mi.load_file(str(shipped), res=str(size), spp="1")
    parts = {"type": "scene", "sensor": scene.sensors()[0]}
    parts |= {f"shape{i}": shape for i, shape in enumerate(scene.shapes())}
    if callable(light):
        light = light(np.array(parts["sensor"].world_transform().translation()).ravel())
    return mi.load_dict(parts | {"light": light})


def medium_of(scene):
    """Its ``nrf`` medium."""
    return next(m for s in scene.shapes() if getattr(m := s.interior_medium(), "is_nrf", False))


def integrator(columns: int, rows: int, **options):
    """Return an integrator with as many lights as the environment has texels."""
    return mi.load_dict({"type": "nrf", "visibility": "transmittance_map", "samples": SAMPLES, "hide_emitters": True,
                         "environment_lights": columns * rows, **options})


def timed(scene, integrator_, repeats: int, first: bool = True) -> list[float]:
    """Wall seconds of each of `repeats` renders, after a `first` one that compiles."""
    found = []
    seed: Any  # a number, where Mitsuba's stub asks for an array
    for seed in range(repeats + first):
        dr.sync_thread()
        start = time.perf_counter()
        dr.eval(mi.render(scene, integrator=integrator_, seed=seed, spp=1))
        dr.sync_thread()
        found.append(time.perf_counter() - start)
    return found[first:]


def in_own_process(size: int, columns: int, rows: int, repeats: int, home: Path | None = None) -> dict:
    """``seconds`` (list) and ``peak_bytes`` of such renders in a fresh process, and ``process_seconds``, its own.

    `home`: the folder of all that it finds and leaves for later processes, Dr.Jit's kernels and our maps; with it, the
    first picture is the process's first. None: the user's, without maps if the caller makes them anew.
    """
    words = [sys.executable, "-m", "benchmarks.bench_image", "--size", str(size), "--columns", str(columns),
             "--rows", str(rows), "--repeats", str(repeats), "--variant", str(mi.variant())]
    environment = dict(os.environ)
    if home is not None:
        words.append("--first")
        environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache"), "MI_NTF_CACHE": "on"}
    start = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    process = time.perf_counter() - start
    if done.returncode:
        raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; its output ends with\n"
                         f"{(done.stdout + done.stderr)[-4000:]}")
    return json.loads(done.stdout.splitlines()[-1]) | {"process_seconds": process}


def main() -> None:
    """The process of :func:`in_own_process`."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name, value in (("size", 600), ("columns", 50), ("rows", 10), ("repeats", 3)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--first", action="store_true")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    from mi_ntf import render

    render.register()
    if not options.first:
        # Compiles: kernels hold neither the image's size nor the lights.
        timed(under_sky(32, 4, 2), integrator(4, 2), 1)
    scene, nrf = under_sky(options.size, options.columns, options.rows), integrator(options.columns, options.rows)
    found = timed(scene, nrf, options.repeats, first=False)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    print(json.dumps({"seconds": found, "peak_bytes": peak}))


if __name__ == "__main__":
    main()
