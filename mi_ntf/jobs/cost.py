"""What an engine costs on this machine: ``python -m mi_ntf.jobs.cost [ENGINE …]``.

A task that does nothing, and two workers of one thread each against one, on work that keeps a core busy. Other work on
the machine makes both look worse: the load is printed beside them.
"""

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from . import Workers, each

ROUNDS = 40
"""Tasks of a measurement of the speed."""


def nothing(task: int) -> int:
    """A task that does nothing."""
    return task


def busy(loops: int) -> int:
    """A task that keeps one core busy, in this process alone."""
    found = 0
    for k in range(loops):
        found = (found * 1103515245 + k) & 0xFFFFFFFF
    return found


def measure(engine: Any, count: int, workers: int = 2) -> dict[str, float]:
    """Seconds until the first of `count` tasks is done, ``start``, and for each of the others, ``per_task``."""
    took = _times(nothing, list(range(count)), Workers(engine, workers, 1))
    return {"start": took[0], "per_task": (took[-1] - took[0]) / (count - 1)}


def speedup(engine: Any, seconds: float = 10.0) -> float:
    """How many times faster two workers are than one, both with one thread, on work that takes one about `seconds`;
    from the first result on, when all have begun."""
    start = time.perf_counter()
    busy(1_000_000)
    loops = max(1, int(1_000_000 * seconds / ROUNDS / (time.perf_counter() - start)))
    rates = []
    for workers in (1, 2):
        took = _times(busy, [loops] * ROUNDS, Workers(engine, workers, 1))
        first = workers  # of each worker one result, by then
        rates.append((ROUNDS - first) / (took[-1] - took[first - 1]))
    return rates[1] / rates[0]


def _times(work: Any, tasks: list, workers: Workers) -> list[float]:
    """Seconds after which tasks were done, one after the other."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        return [time.perf_counter() - start for _ in each(work, tasks, workers, folder=Path(folder), quiet=True)]


def main(engines: list[str]) -> None:
    """Print a line an engine."""
    for engine in engines or ["local", "submitit", "dask"]:
        found, load = measure(engine, 1000), os.getloadavg()[0]
        print(f"{engine:9} start {found['start']:.2f} s, a task {1000 * found['per_task']:.2f} ms, load {load:.1f}; "
              f"two workers {speedup(engine):.2f} times as fast as one, load {os.getloadavg()[0]:.1f}", flush=True)


if __name__ == "__main__":
    from mi_ntf.jobs import cost  # so that workers find its tasks by name

    cost.main(sys.argv[1:])
