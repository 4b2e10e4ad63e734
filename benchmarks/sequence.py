"""Cost of the frames of a sequence beside calls of the stock program: ``results/sequence.json``.

    python -m benchmarks.sequence [--frames 120] [--calls 6] [--size 256]

The scene ``statue`` with 4 samples a pixel, ``transmittance_map`` of 128² texels, and a point light on a circle. Calls
of the stock program render the first frame between the others, so that other work on the machine slows both down.
Their number is extrapolated to that of the frames. Kernels of both are compiled before, and both read the field from
the cache, the calls also their map. Takes about 3 minutes on two cores.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from mi_ntf.sequence import command, timeline, work

from . import record, scenes

SCENE = scenes.SCENES / "statue" / "scene.xml"
LIGHT: dict[str, Any] = {"start": [1.5, 2.6, 2.7], "centre": [0.1, 0, 0]}
STARTS = 1.5
"""Seconds until Python has started and imported the package, which every stock call pays."""


def line(frames: int, size: int) -> timeline.Timeline:
    """Return the timeline of a light that goes once around."""
    degrees = {"keys": [[0, 0], [frames, 360]], "interpolation": "linear"}
    values = {"spp": "4", "visibility": "transmittance_map", "map": "128", "res": str(size)}
    return timeline.parse({"frames": frames, "lights": {"point": {"position": LIGHT | {"degrees": degrees}}}}, values)


def stock(values: dict[str, str], folder: Path) -> float:
    """Return the seconds of one call."""
    program = Path(sys.executable).parent / "mitsuba"
    words = [word for name, value in values.items() for word in ("-D", f"{name}={value}")]
    start = time.perf_counter()
    subprocess.run([program, "-m", "llvm_ad_rgb", *words, "-o", folder / "stock.exr", SCENE], check=True,
                   capture_output=True)
    return time.perf_counter() - start


def measure(frames: int, calls: int, size: int) -> dict[str, Any]:
    """Return seconds of the first and of further frames, the first and last 30 of them apart, and of stock calls.

    ``processor`` holds processor seconds, which other work disturbs less; ``memory`` holds MiB after the second and the
    last frame; ``ratio`` is that of all stock calls and all frames.
    """
    seconds: list[float] = []
    processor: list[float] = []
    memory: list[float] = []
    others: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        tasks = command.tasks_of(SCENE, Path(folder), line(frames, size).frames, variant="llvm_ad_rgb")
        values = tasks[0].frame.parameters
        warm = [sys.executable, "-m", "mi_ntf", "sequence", str(SCENE), "-o", f"{folder}/warm"]
        subprocess.run([*warm, *(w for k, v in values.items() for w in ("-D", f"{k}={v}"))], check=True,
                       capture_output=True)
        stock(values, Path(folder))
        every = max(1, frames // calls)
        for i, task in enumerate(tasks):
            start = time.process_time()
            seconds.append(work.render(task))
            processor.append(time.process_time() - start)
            memory.append(_memory())
            if i % every == every - 1:
                others.append(stock(values, Path(folder)))
    calls_spread = record.spread(others)
    return {"frames": frames, "size": size, "first": seconds[0], **_parts(seconds), "processor": _parts(processor),
            "memory": [memory[1], memory[-1]], "stock": calls_spread,
            "ratio": frames * calls_spread["median"] / (STARTS + sum(seconds))}


def _parts(values: list[float]) -> dict[str, dict[str, float]]:
    parts = {"each": values[1:], "early": values[1:31], "late": values[-30:]}
    return {name: record.spread(part) for name, part in parts.items()}


def _memory() -> float:
    """Return the memory of this process in MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """Measure and write the results."""
    options = record.options(__doc__, *((f"--{name}", {"type": int, "default": value})
                                        for name, value in (("frames", 120), ("calls", 6), ("size", 256))))
    start = time.perf_counter()
    values = measure(8, 2, 16) if options.quick else measure(options.frames, options.calls, options.size)
    record.write("sequence", values, start, options.out)


if __name__ == "__main__":
    main()
