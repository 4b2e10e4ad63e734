"""The promise of `max_error` on random scenes: the error of the picture is below it.

    python tests/hard_cases/promise.py [--scenes 200] [--seed 0] [--minutes 60]
    python tests/hard_cases/promise.py --seconds [--scenes 40]

Every scene is rendered by ``auto`` under each limit of ``LIMITS``, and by the march with the same seed. It counts as
one frame of a million, so that everything is tried that could be worth it. Its fields are voxels, since networks take a
minute to compile. One line a scene, and a table at the end. Exit code 1 if fewer than ``KEPT`` of the pictures keep to
a limit.

With ``--seconds``, scenes with surfaces are rendered as one picture of ``SIDE`` squared pixels, under `max_error` 2 %
and by each fixed method. The ratio is that of the seconds, compilation left out, to those of the fastest method that
keeps to the limit.
"""

import argparse
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

import mitsuba as mi
import numpy as np
from helpers import random_scenes

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render import timing
from mi_ntf.render.maps import map_cache

LIMITS = (0.01, 0.02, 0.05)
KEPT = 0.95
SIDE, FIXED = 128, ("raymarch", "transmittance_atlas", "transmittance_map")


def errors(seed: int, files: dict, limits=LIMITS) -> list[tuple[float, float, str]]:
    """Return ``(limit, error, choice)`` of the scene of `seed` under each limit; none where nothing is to be chosen."""
    what = random_scenes.draw(seed, files)
    for shape in what.scene.values():
        shape.get("interior", {}).pop("representation", None)
    own = {k: v for k, v in what.integrator.items() if k not in ("noise_threshold", "time_budget", "aovs")}
    scene = mi.load_dict({"type": "scene", **what.scene})

    def picture(**changed):
        nrf = mi.load_dict(own | changed)
        image = np.array(mi.render(scene, integrator=nrf, seed=seed % 1000), np.float64)[..., : what.coloured]
        return image, nrf.achieved

    truth, _ = picture(visibility="raymarch", max_error=0.0)
    power = float((truth**2).mean())
    results = []
    for limit in limits if power > 0 else ():
        image, achieved = picture(visibility="auto", max_error=limit, frames=1 << 20)
        taken = [t["name"] for t in achieved["trials"] if t["taken"]]
        if len(achieved["trials"]) > 1:
            results.append((limit, float(np.sqrt(((image - truth) ** 2).mean() / power)), taken[-1]))
    return results


def ratio(seed: int, files: dict) -> tuple[float, str]:
    """Return the seconds of the scene of `seed` under `max_error` 2 % over the best fixed method's, and the choice; 0
    where it has no surface or is dark."""
    what = random_scenes.draw(seed, files)
    if not {"floor", "ball"} & set(what.scene) or what.scene["sensor"]["type"] != "perspective":
        return 0.0, ""
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = mi.load_dict({"type": "scene", **what.scene, "sensor": what.scene["sensor"] | {"film": film}})
    own = {k: v for k, v in what.integrator.items() if k not in ("noise_threshold", "time_budget", "aovs")}

    def picture(**changed) -> tuple[np.ndarray, float, dict]:
        with map_cache.in_memory():
            mi.render(scene, integrator=mi.load_dict(own | changed), seed=1)  # compiles
            map_cache.forget()
            nrf = mi.load_dict(own | changed)
            image, took = timing.once(scene, nrf, 0, 1)
            return np.array(image, np.float64), took["wall_seconds"] - took["compile_seconds"], nrf.achieved

    truth, march, _ = picture(visibility="raymarch", max_error=0.0)
    if not truth.any():
        return 0.0, ""
    seconds = [march]
    for name in FIXED[1:]:
        if name != "transmittance_map" or not own["light_samples"]:
            image, took, _ = picture(visibility=name, max_error=0.0)
            if ((image - truth) ** 2).mean() <= 0.02**2 * (truth**2).mean():
                seconds.append(took)
    _, took, achieved = picture(visibility="auto", max_error=0.02)
    return took / min(seconds), f"{took:.2f} s by {achieved['visibility']}, best {min(seconds):.2f}, march {march:.2f}"


def ratios(scenes: int, seed: int, files: dict, say=print) -> list[float]:
    """Return :func:`ratio` of so many scenes with surfaces, from `seed` on."""
    found: list[float] = []
    while len(found) < scenes:
        try:
            value, text = ratio(seed, files)
        except (MiNtfError, RuntimeError) as error:
            value, text = 0.0, f"refused, {str(error).splitlines()[-1][:100]}"
        if value:
            found.append(value)
            say(f"seed {seed}: {value:.2f}, {text}")
        seed += 1
    return found


def check(scenes: int, seed: int, files: dict, seconds: float, say=print) -> tuple[dict, list[str]]:
    """Return, for each limit, how many pictures were chosen for, how many of them not by the whole march, and how many
    keep to the limit; and a line for each that does not."""
    counts, failures, begin = {limit: np.zeros(3, int) for limit in LIMITS}, [], time.monotonic()
    for k in range(seed, seed + scenes):
        if time.monotonic() - begin > seconds:
            say(f"only {k - seed} of {scenes} scenes within {seconds:.0f} s")
            break
        try:
            found = errors(k, files)
        except (MiNtfError, RuntimeError) as error:
            say(f"seed {k}: refused, {str(error).splitlines()[-1][:100]}")
            continue
        for limit, error, choice in found:
            kept = error <= limit
            counts[limit] += (1, choice != "raymarch", kept)
            if not kept:
                failures.append(f"seed {k}: max_error {limit:g}, error {error:.4f} by {choice}")
        say(f"seed {k}: " + "; ".join(f"{limit:g}: {error:.4f} {choice}" for limit, error, choice in found))
    return counts, failures


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seconds", action="store_true")
    arguments = parser.parse_args()

    def say(text: str) -> None:
        print(text, flush=True)

    with random_scenes.prepared() as files:
        if arguments.seconds:
            found = ratios(arguments.scenes, arguments.seed, files, say)
            say(f"median {np.median(found):.2f}, largest {max(found):.2f} of {len(found)}")
            return 0
        counts, failures = check(arguments.scenes, arguments.seed, files, 60 * arguments.minutes, say)
    print(*failures, sep="\n")
    for limit, (chosen, other, kept) in counts.items():
        print(f"max_error {limit:g}: {kept} of {chosen} pictures keep to it ({kept / max(chosen, 1):.1%}), "
              f"{other} of them not by the whole march")
    return int(any(kept < KEPT * chosen for chosen, _, kept in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
