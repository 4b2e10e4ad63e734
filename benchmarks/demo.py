"""`make demo`: the stock `mitsuba` program renders the shipped scene three ways, then `mi-ntf tradeoff` studies it; a
table and a picture show the outcome.

    python -m benchmarks.demo [--out out/demo] [--scene statue] [--size 256] [--spp 16] [--environment-spp 4]
                                   [--budget 120s]

Writes to `out`: one EXR a render, ``table.md``, ``metrics.json``, ``comparison.png``, and the study's report in
``tradeoff``. Exit code 1 if a render or the study fails; the study comes last and takes nothing of the rest with it.

Seconds are those of work that is done: renders and study are processes without a cache of transmittance maps, and the
study takes up nothing that an earlier one, interrupted or not, has left in the folder.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.compare import read_image

from .demo_report import LIGHTS, Shot, picture, report

VISIBILITIES = ("raymarch", "neural_transmittance", "transmittance_map")
TIMEOUT = 600
"""Seconds after which one render counts as hung, and a study that has taken so much more than its budget."""
REPORT = ("index.html", "tradeoff.csv", "tradeoff.json")
"""Files of a study's report."""


def program() -> tuple[list[str], str]:
    """``(command, note)``: the stock renderer where the bridge is installed, else our look-alike; `note` says which."""
    from mi_ntf.doctor import check_bridge

    stock = Path(sys.executable).parent / "mitsuba"
    bridge = check_bridge()
    if stock.is_file() and bridge.ok:
        return [str(stock)], "rendered by the stock `mitsuba` program"
    why = f"no program {stock}" if bridge.ok else bridge.found
    look_alike = [sys.executable, "-m", "mi_ntf", "render"]
    return look_alike, f"rendered by `mi-ntf render`, since the bridge is missing ({why})"


def environment() -> dict[str, str]:
    """Return the environment variables of all processes whose seconds are shown: those of this process, with the cache
    of fields and maps off."""
    return {**os.environ, "MI_NTF_CACHE": "off"}


def render(command: list[str], scene: Path, light: str, visibility: str, spp: int, size: int, out: Path) -> Shot:
    """Run one render of `size`² pixels as a process of its own. Raises :class:`MiNtfError` with the end of its output
    if it fails."""
    chosen = (f"light={light}", f"visibility={visibility}", f"spp={spp}", f"res={size}")
    defines = [w for d in chosen for w in ("-D", d)]
    words = [*command, "-m", "llvm_ad_rgb", *defines, "-o", str(out), str(scene)]
    start = time.perf_counter()
    try:
        done = subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        raise MiNtfError(f"{' '.join(words)}\ndid not end within {TIMEOUT} s; "
                         "try fewer samples (--spp, --environment-spp)") from None
    seconds = time.perf_counter() - start
    if done.returncode or not out.is_file():
        raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; its output ends with\n"
                         f"{(done.stdout + done.stderr)[-4000:]}\n`mi-ntf doctor` looks for the cause")
    return Shot(light, visibility, seconds, read_image(out))


def study(command: list[str], scene: Path, out: Path, budget: str, size: int, spp: int) -> dict[str, Any]:
    """Run `mi-ntf tradeoff` (`command`: `mi-ntf`) on `scene` under its environment map for `budget`, as a process of
    its own that shows what it does; its report lies in `out`. `size`, `spp`: the scene's own pixels along a side and
    samples a pixel.

    It begins anew: seconds that an earlier study measured in `out` are not those of this run.

    Returns what ``tradeoff.json`` holds. Raises MiNtfError where the study fails, or every way of it.
    """
    from mi_ntf.evaluate.kept import NAME

    if (out / NAME).is_file():
        print(f"{out}: what an earlier study measured there is dropped, the demo measures anew", file=sys.stderr)
    for name in (NAME, *REPORT):
        (out / name).unlink(missing_ok=True)
    defines = [w for d in ("light=env", f"res={size}", f"spp={spp}") for w in ("-D", d)]
    words = [*command, "tradeoff", str(scene), *defines, "--budget", budget, "-o", str(out)]
    try:
        done = subprocess.run(words, env=environment(), timeout=TIMEOUT + seconds_of(budget), check=False)
    except subprocess.TimeoutExpired as error:
        raise MiNtfError(f"{' '.join(words)}\ndid not end within {error.timeout:.0f} s") from None
    path = out / "tradeoff.json"
    if done.returncode or not path.is_file():
        raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; what it said stands above")
    found = json.loads(path.read_text(encoding="utf-8"))
    rows = found["ways"]
    if rows and not any(row["points"] for row in rows):
        raise MiNtfError(f"every way of the study failed, the first one since {rows[0]['reason']}; see {out}")
    return found


def seconds_of(budget: str) -> float:
    """The seconds of a budget such as 90s or 5m. Raises MiNtfError."""
    from mi_ntf.evaluate.budget import seconds

    return seconds(budget)


def demo(out: Path = Path("out/demo"), scene: str = "statue", size: int = 256, spp: int = 16,
         environment_spp: int = 4, budget: str = "120s") -> None:
    """Render a shipped scene in three visibilities under two lights and compare; then study what accuracy costs.

    Args:
        out: folder for images, table, picture and the study's report.
        scene: name of a folder of scenes/, or the path of another that holds the same files.
        size: pixels along a side, a divisor of the references' 256.
        spp: samples per pixel under the point light.
        environment_spp: the same under the environment map, whose hundreds of lights each sample pays for.
        budget: how long the study of the scene under its environment map may take: 90s, 5m.
    """
    from rich.console import Console

    folder = Path(__file__).parents[1] / "scenes" / scene  # an absolute path stays what it is
    if not (folder / "scene.xml").is_file():
        raise MiNtfError(f"{folder / 'scene.xml'} does not exist; run the demo in a checkout, on a scene of scenes/ "
                         "or an absolute path")
    seconds_of(budget)
    references = {light: _reference(folder, light, size) for light in LIGHTS}
    files.make_folder(out)
    command, note = program()
    console = Console()
    console.print(f"{folder / 'scene.xml'}: {note}")
    shots = _shots(command, folder, out, size, {"point": spp, "env": environment_spp}, console)
    text, measured = report(out, shots, references, note)
    print(text)
    path = out / "comparison.png"
    console.print(f"picture: {path}; the study of what accuracy costs follows, {budget}", soft_wrap=True)
    try:
        found = study([sys.executable, "-m", "mi_ntf"], folder / "scene.xml", out / "tradeoff", budget, size,
                      environment_spp)
    except MiNtfError as error:
        raise MiNtfError(f"the study failed; table and picture of the renders are in {out}, without its curves\n{error}"
                         ) from None
    picture(path, shots, references, measured, found)
    console.print(f"picture, now with the study: {path}\nstudy: {out / 'tradeoff' / 'index.html'}", soft_wrap=True)


def _shots(command: list[str], folder: Path, out: Path, size: int, samples: dict[str, int], console) -> list[Shot]:
    """Render the scene in `folder` under all lights by all methods, one after the other.

    `samples`: per pixel, by light.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    shots = []
    with Progress(TextColumn("{task.description:36}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
                  TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("", total=len(LIGHTS) * len(VISIBILITIES))
        for light in LIGHTS:
            for visibility in VISIBILITIES:
                progress.update(task, description=f"{light} · {visibility}")
                file = out / f"{folder.name}_{light}_{visibility}.exr"
                file.unlink(missing_ok=True)
                shots.append(render(command, folder / "scene.xml", light, visibility, samples[light], size, file))
                progress.advance(task)
    return shots


def _reference(folder: Path, light: str, size: int) -> np.ndarray:
    """The path-traced meshes, means of whole pixels where `size` is smaller than what is stored."""
    path = folder / f"reference_{light}.exr"
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; make it with `python scenes/make_references.py {folder.name}`")
    image = read_image(path)
    if not 16 <= size <= len(image) or len(image) % size:
        raise MiNtfError(f"size is {size}, expected a divisor of the reference's {len(image)} pixels, at least 16")
    block = len(image) // size
    return image.reshape(size, block, size, block, -1).mean((1, 3))


def main() -> int:
    """Command line; returns the exit code."""
    import tyro

    try:
        tyro.cli(demo, prog="python -m benchmarks.demo")
    except MiNtfError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
