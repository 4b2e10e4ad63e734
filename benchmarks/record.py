"""Files of results: every script writes one JSON file, ``benchmarks/results/NAME.json``.

    {"about": {"name", "commit", "date", "version", "machine", "command", "seconds"}, "values": {…}}

A former file of that name moves to ``benchmarks/results/history``.
"""

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import mitsuba as mi

from mi_ntf import __version__
from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS
from mi_ntf.render.machine import graphics_card, processor

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
HISTORY = "history"
CODE = ("mi_ntf", "scenes", "benchmarks/*.py", ":!benchmarks/tables.py", ":!benchmarks/all.py")
"""Paths of the checkout that decide a result."""


def prepare(cache: str = "off") -> None:
    """Set Mitsuba's variant, register the plugins, and set the cache of fields and maps: off, memory or on."""
    from mi_ntf.render import register

    os.environ["MI_NTF_CACHE"] = cache
    if mi.variant() is None:
        mi.set_variant(*VARIANTS)
    register()


def commit() -> str:
    """Return the last commit that changed the code, with a plus sign if files of the checkout differ from it."""
    last = _git("log", "-1", "--format=%h", "--", *CODE)
    return last + ("+" if _git("status", "--porcelain", "--untracked-files=no", "--", *CODE) else "")


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def about(name: str, seconds: float) -> dict[str, Any]:
    """Return the header of a result that took so many seconds to measure."""
    if mi.variant() is None:  # the script rendered in other processes, which take the first that this machine can run
        mi.set_variant(*VARIANTS)
    variant = str(mi.variant())
    hardware = graphics_card() if variant.startswith("cuda") else processor()
    machine = {"processor": hardware, "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2),
               "variant": variant, "mitsuba": mi.__version__}
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    command = shlex.join(["python", "-m", f"benchmarks.{name}", *sys.argv[1:]])
    return {"name": name, "commit": commit(), "date": now, "version": __version__, "machine": machine,
            "command": command, "seconds": round(seconds, 1)}


def write(name: str, values: dict[str, Any], start: float, folder: Path | None = None) -> Path:
    """Write a result and return its file. `start`: the value of ``time.perf_counter`` before the measurement."""
    folder = folder or RESULTS
    path = folder / f"{name}.json"
    files.make_folder(folder)
    if path.is_file():
        former = json.loads(path.read_text(encoding="utf-8"))["about"]
        files.make_folder(folder / HISTORY)
        path.rename(folder / HISTORY / f"{name}-{former['date'][:19].replace(':', '')}-{former['commit']}.json")
    result = {"about": about(name, time.perf_counter() - start), "values": values}
    files.write(path, json.dumps(result, indent=1, ensure_ascii=False, default=float) + "\n")
    print(f"{path}: {result['about']['seconds']:.0f} s", file=sys.stderr)
    return path


def read(name: str, folder: Path | None = None) -> dict[str, Any]:
    """Return a result with the keys ``about`` and ``values``. Raises MiNtfError where there is none."""
    path = (folder or RESULTS) / f"{name}.json"
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; run `python -m benchmarks.{name}`")
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return result


def spread(values: Iterable[float]) -> dict[str, float]:
    """Return median, least and largest of repeated measurements, and their number."""
    numbers = [float(v) for v in values]
    return {"median": statistics.median(numbers), "min": min(numbers), "max": max(numbers), "repeats": len(numbers)}


def ratio(slow: Sequence[float], fast: Sequence[float]) -> dict[str, float]:
    """Return the spread of the ratios of measurements that were made in turn."""
    return spread(a / b for a, b in zip(slow, fast, strict=True))


def options(text: str, *more: tuple[str, dict[str, Any]]) -> argparse.Namespace:
    """Parse the command line of a script: ``--out``, ``--quick``, and `more` options as names and keyword arguments.

    `text` is the script's docstring. Settings other than the defaults must not go into the results of the pages.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that everything runs; needs --out")
    for name, rest in more:
        parser.add_argument(name, **rest)
    parsed = parser.parse_args()
    changed = [name for name, value in vars(parsed).items() if value != parser.get_default(name) and value != []]
    if changed and parsed.out == RESULTS:
        parser.error(f"the pages show results of the default settings; with {', '.join(changed)}, name another folder "
                     "with --out")
    return parsed
