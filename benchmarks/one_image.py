"""Renders of the statue under a sky of many lights in a process of their own.

    python -m benchmarks.one_image --size 600 --columns 50 --rows 10 [--repeats 3] [--first]

Prints JSON: the seconds of each render, and the peak memory of the process. A small render compiles before, unless
``--first`` asks for the first picture of the process.
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

from mi_ntf.core.errors import MiNtfError

from . import scenes

SAMPLES = 192


def integrator(columns: int, rows: int, **properties: Any) -> Any:
    """Return an integrator by maps with one light for each texel of the environment."""
    return scenes.integrator(**{"visibility": "transmittance_map", "samples": SAMPLES,
                                "environment_lights": columns * rows, **properties})


def timed(scene: Any, nrf: Any, repeats: int, first: bool = True) -> list[float]:
    """Return the wall seconds of each of `repeats` renders of one sample, after a `first` one that compiles."""
    seconds = []
    seed: Any  # a number, where Mitsuba's stub asks for an array
    for seed in range(repeats + first):
        dr.sync_thread()
        start = time.perf_counter()
        dr.eval(mi.render(scene, integrator=nrf, seed=seed, spp=1))
        dr.sync_thread()
        seconds.append(time.perf_counter() - start)
    return seconds[first:]


def run(size: int, columns: int, rows: int, repeats: int, home: Path | None = None) -> dict[str, Any]:
    """Return what a process prints that renders so, and its own ``process_seconds``.

    `home` is the folder in which the process finds and leaves kernels and maps; with it, the first picture is timed.
    None stands for the user's kernels, and for no maps.
    """
    words = [sys.executable, "-m", "benchmarks.one_image", "--size", str(size), "--columns", str(columns), "--rows",
             str(rows), "--repeats", str(repeats), "--variant", str(mi.variant())]
    environment = dict(os.environ)
    if home is not None:
        words.append("--first")
        environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache"), "MI_NTF_CACHE": "on"}
    start = time.perf_counter()
    done = subprocess.run(words, cwd=scenes.SCENES.parent, capture_output=True, text=True, check=False,
                          env=environment)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; its output ends with\n"
                         f"{(done.stdout + done.stderr)[-4000:]}")
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result | {"process_seconds": seconds}


def main() -> None:
    """Render and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("size", 600), ("columns", 50), ("rows", 10), ("repeats", 3)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--first", action="store_true")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    from mi_ntf import render

    render.register()
    if not options.first:  # compiles: kernels depend neither on the picture's size nor on the number of lights
        timed(scenes.under_sky(32, 4, 2), integrator(4, 2), 1)
    scene = scenes.under_sky(options.size, options.columns, options.rows)
    seconds = timed(scene, integrator(options.columns, options.rows), options.repeats, first=False)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    print(json.dumps({"seconds": seconds, "peak_bytes": peak}))


if __name__ == "__main__":
    main()
