"""Cost of the frames of a sequence, compared with calls of the stock program.

    python -m benchmarks.frames [--frames 120] [--calls 6] [--size 256]

The scene ``statue``, 4 samples a pixel, `transmittance_map` of 128² texels, a point light on a circle. Stock calls, of
frames alike, stand between the frames, so that other work on the machine slows down both; their number is extrapolated
to that of the frames. Kernels of both are compiled before. One JSON object: seconds of ``first`` and ``each`` (median)
frame, the medians ``early`` (2nd to 31st) and ``late`` (last 30), ``processor`` seconds likewise, which other work
disturbs less; ``memory`` (MiB) after the 2nd and the last frame; ``stock`` seconds of each call; ``ratio``.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mi_ntf.sequence import command, timeline, work

SCENE = Path(__file__).parents[1] / "scenes/statue/scene.xml"
LIGHT = {"start": [1.5, 2.6, 2.7], "centre": [0.1, 0, 0]}
STARTS = 1.5
"""Seconds until Python has begun and imported, which stock calls pay each."""


def line(frames: int, size: int) -> timeline.Timeline:
    """The light once around."""
    degrees = {"keys": [[0, 0], [frames, 360]], "interpolation": "linear"}
    values = {"spp": "4", "visibility": "transmittance_map", "map": "128", "res": str(size)}
    return timeline.of({"frames": frames, "lights": {"point": {"position": LIGHT | {"degrees": degrees}}}}, values)


def stock(values: dict[str, str], folder: Path) -> float:
    """Seconds of one call, maps made anew."""
    program = Path(sys.executable).parent / "mitsuba"
    words = [word for name, value in values.items() for word in ("-D", f"{name}={value}")]
    begin = time.perf_counter()
    subprocess.run([program, "-m", "llvm_ad_rgb", *words, "-o", folder / "stock.exr", SCENE], check=True,
                   capture_output=True, env={**os.environ, "MI_NTF_CACHE": "off"})
    return time.perf_counter() - begin


def measure(frames: int, calls: int, size: int) -> dict:
    """See the module."""
    seconds, processor, memory, others = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        tasks = command.tasks_of(SCENE, Path(folder), line(frames, size).frames, variant="llvm_ad_rgb")
        warm = [sys.executable, "-m", "mi_ntf", "sequence", str(SCENE), "-o", f"{folder}/warm"]
        values = tasks[0].frame.parameters
        subprocess.run([*warm, *(w for k, v in values.items() for w in ("-D", f"{k}={v}"))], check=True,
                       capture_output=True)
        stock(values, Path(folder))
        every = max(1, frames // calls)
        for i, task in enumerate(tasks):
            begin = time.process_time()
            seconds.append(work.render(task)["seconds"])
            processor.append(time.process_time() - begin)
            memory.append(_memory())
            if i % every == every - 1:
                others.append(stock(values, Path(folder)))
    return {"frames": frames, "size": size, "first": seconds[0], **_medians(seconds), "processor": _medians(processor),
            "memory": [memory[1], memory[-1]], "stock": others,
            "ratio": frames * float(np.median(others)) / (STARTS + sum(seconds))}


def _medians(values: list) -> dict[str, float]:
    of = {"each": values[1:], "early": values[1:31], "late": values[-30:]}
    return {name: float(np.median(part)) for name, part in of.items()}


def _memory() -> float:
    """MiB of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frames")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--calls", type=int, default=6)
    parser.add_argument("--size", type=int, default=256)
    args = parser.parse_args()
    print(json.dumps(measure(args.frames, args.calls, args.size), indent=2))


if __name__ == "__main__":
    main()
