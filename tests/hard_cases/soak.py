"""Random scenes in one process, for as long as it takes something to break.

    python tests/hard_cases/soak.py [--scenes 200] [--seed 0] [--minutes 30]    # one process, all checks
    python tests/hard_cases/soak.py --pairs 60 [--seed 0] [--minutes 30]        # against stock volpath, z-tests

A failure is printed with its seed, which belongs into ``FAILED`` of test_soak.py. Exit code 1 if there is one.
"""

import argparse
import ctypes
import gc
import sys
import time
import traceback
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

import drjit as dr
import mitsuba as mi
import numpy as np
from helpers import random_scenes, ztest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.scene import loaded

WARM_UP = 20
"""Scenes after which memory may no longer grow: fields and caches have been seen by then. Read as often."""
GROWTH = 1.05
SMOOTH = 3
"""Readings at either end whose means are compared: a single one swings by 4 %, as the heap is more or less in
pieces."""
PER_KERNEL = 0.008
"""MiB that LLVM keeps for good of every kernel compiled: the same 200 scenes leave 15 MiB behind where they compile
2500 kernels, and 5 MiB (2 %) where these come from the disk."""
SLOW = 150.0
"""Seconds that no scene may take on a busy machine: several fields as networks among surfaces compile for a minute."""


def render(what: random_scenes.Scene) -> np.ndarray:
    """The picture (h, w, c)."""
    loaded = mi.load_dict({"type": "scene", "integrator": what.integrator, **what.scene})
    return np.array(mi.render(loaded, seed=what.seed % 1000), np.float64)


def check(what: random_scenes.Scene) -> str:
    """Return the faults of the scene's picture, or "refused: …" if one sentence says why it is not rendered."""
    try:
        image = render(what)
    except Exception as error:
        text = refusal(error)
        if text is None:
            return "exception: " + "".join(traceback.format_exception(error))
        return f"refused: {text}" if "\n" not in text else f"a refusal of several lines: {text}"
    if not np.isfinite(image).all():
        return f"{(~np.isfinite(image)).sum()} of {image.size} numbers are not finite"
    colours = image[..., : what.coloured]
    if not what.signed and colours.min() < 0:
        return f"{(colours < 0).sum()} of {colours.size} colours are negative, down to {colours.min():.3g}"
    return ""


def refusal(error: BaseException) -> str | None:
    """The sentence of a MiNtfError, also where Mitsuba has put it into an error of its own; None for any other."""
    reason = error
    while reason is not None and not isinstance(reason, MiNtfError):
        reason = reason.__cause__ or reason.__context__
    if reason is not None:
        return str(reason)
    _, found, text = str(error).rpartition("MiNtfError: ")
    return text.strip() if found else None


def memory() -> tuple[float, float]:
    """MiB that this process holds: resident, and Dr.Jit's, without what caches keep of scenes that are gone."""
    loaded._load.cache_clear()
    gc.collect()
    gc.collect()
    dr.sync_thread()
    dr.flush_kernel_cache()
    dr.flush_malloc_cache()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    dr.detail.malloc_clear_statistics()
    own = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20, own / 2**20


def soak(scenes: int, seed: int, files: dict, seconds: float, say=print) -> list[str]:
    """Render `scenes` random scenes from `seed` on; the failures, in words."""
    failures, refused, compiled, times, held = [], 0, 0, [], []
    begin = time.monotonic()
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    for k in range(scenes):
        if time.monotonic() - begin > seconds:
            failures.append(f"only {k} of {scenes} scenes within {seconds:.0f} s")
            break
        start = time.monotonic()
        what = random_scenes.draw(seed + k, files)
        found = check(what)
        compiled += sum(k["type"] == dr.KernelType.JIT and not k["cache_hit"] for k in dr.kernel_history())
        dr.kernel_history_clear()
        times.append(time.monotonic() - start)
        if found.startswith("refused"):
            refused += 1
        elif found:
            failures.append(f"seed {what.seed}: {found}\n    {what.what}")
        if times[-1] > SLOW:
            failures.append(f"seed {what.seed}: {times[-1]:.0f} s\n    {what.what}")
        say(f"{k + 1}/{scenes} seed {what.seed}: {times[-1]:.1f} s {found[:150].splitlines()[0] if found else ''}")
        if (k + 1) % WARM_UP == 0:
            resident, arrays = memory()
            say(f"    {resident:.0f} MiB resident, {arrays:.1f} MiB of Dr.Jit's arrays, {compiled} kernels compiled")
            held.append((resident, resident - PER_KERNEL * compiled, arrays))
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    if len(held) >= 2 * SMOOTH:
        first, last = np.mean(held[:SMOOTH], 0), np.mean(held[-SMOOTH:], 0)
        growth = f"memory grew from {first.round(1)} to {last.round(1)} MiB (resident, without code, Dr.Jit's arrays)"
        say(growth)
        if max(last[1] - first[1], last[2] - first[2]) > (GROWTH - 1) * first[1]:
            failures.append(growth)
    times = np.array(times)
    say(f"{len(times)} scenes, {refused} refused, {len(failures)} failures; median {np.median(times):.1f} s, "
        f"longest {times.max():.1f} s, {time.monotonic() - begin:.0f} s in all")
    return failures


def compare(seed: int, files: dict) -> str:
    """Return the faults that a z-test finds between pictures of one seed, ours and that of ``volpath``.

    A pair that fails is rendered again with more samples and other seeds. By chance this happens to one pair of ten
    thousand.
    """
    what, theirs = random_scenes.draw_pair(seed, files)
    scene = {"type": "scene", **what.scene}
    loaded = [mi.load_dict({**scene, "integrator": i}) for i in (what.integrator, theirs)]
    for attempt in range(2):
        seeds = range(100 * attempt, 100 * attempt + 4 + 4 * attempt)
        pair = [[np.array(mi.render(s, seed=k, spp=spp))[..., :3] for k in seeds]
                for s, spp in zip(loaded, (16, 192), strict=True)]  # fmt: skip
        try:
            ztest.check(*pair, f"seed {seed}", block=4)
            return ""
        except AssertionError as error:
            found = f"{error}\n    {what.what}"
    return found


def pairs(count: int, seed: int, files: dict, seconds: float, say=print) -> list[str]:
    """Compare `count` pairs from `seed` on; the failures, in words."""
    failures, begin = [], time.monotonic()
    for k in range(count):
        if time.monotonic() - begin > seconds:
            failures.append(f"only {k} of {count} pairs within {seconds:.0f} s")
            break
        start = time.monotonic()
        found = compare(seed + k, files)
        failures += [found] if found else []
        say(f"{k + 1}/{count} seed {seed + k}: {time.monotonic() - start:.1f} s {found}")
    return failures


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--pairs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=30.0)
    arguments = parser.parse_args()
    with random_scenes.prepared() as files:
        run, count = (pairs, arguments.pairs) if arguments.pairs else (soak, arguments.scenes)
        failures = run(count, arguments.seed, files, 60 * arguments.minutes, lambda text: print(text, flush=True))
    print(f"{len(failures)} failures", *failures, sep="\n")
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
