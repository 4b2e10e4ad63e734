"""The demo: the stock `mitsuba` program renders a scene in three visibilities, then `mi-ntf tradeoff` studies it.

    python -m benchmarks.demo [--out out/demo] [--scene statue] [--size 256] [--spp 16] [--environment-spp 4]
                              [--budget 120s] [--repeats 1] [--results]

The folder of ``--out`` receives an EXR of each render, ``table.md``, ``metrics.json``, ``comparison.png``, and the
report of the study in ``tradeoff``. The exit code is 1 if a render or the study fails. ``--results`` renders three
times in place of once, and writes ``benchmarks/results/demo.json``.

Seconds are those of whole processes without a cache of fields and maps. The study never continues an earlier one.
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.budget import seconds as seconds_of
from mi_ntf.evaluate.compare import compare_arrays, read_image
from mi_ntf.evaluate.curves import draw
from mi_ntf.evaluate.metrics import relative_rmse, srgb

from . import record, tables

LIGHTS = tables.LIGHTS
VISIBILITIES = ("raymarch", "neural_transmittance", "transmittance_map")
TIMEOUT = 600
"""Seconds after which a render counts as hung, and a study that has taken so much longer than its budget."""
REPORT = ("index.html", "tradeoff.csv", "tradeoff.json")
"""Files of a study's report."""
RECORDED = 3
"""Renders of each picture whose seconds are recorded."""
ERROR_SCALE = 0.5
"""Upper end of the error maps, in units of the reference's root mean square."""
CURVE_HEIGHT = 4.8
"""Height of the study's curves in inches; a picture is 3.1 wide."""
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Shot:
    """A render: linear RGBA (h, w, 4), and the wall seconds of each process that rendered it, start included."""

    light: str
    visibility: str
    seconds: list[float]
    image: np.ndarray

    def measure(self, reference: np.ndarray, marched: np.ndarray) -> dict[str, Any]:
        """Return the metrics of :func:`mi_ntf.evaluate.compare.compare_arrays`, and relative RMSE to `raymarch`."""
        return {"light": self.light, "visibility": self.visibility, "seconds": record.spread(self.seconds),
                **compare_arrays(self.image[..., :3], reference[..., :3], reference[..., 3]),
                "relative_rmse_to_raymarch": relative_rmse(self.image[..., :3], marched[..., :3])}


def program() -> tuple[list[str], str]:
    """Return the stock renderer where the bridge is installed, else our look-alike, and words that say which."""
    from mi_ntf.doctor import check_bridge

    stock = Path(sys.executable).parent / "mitsuba"
    bridge = check_bridge()
    if stock.is_file() and bridge.ok:
        return [str(stock)], "rendered by the stock `mitsuba` program"
    reason = f"no program {stock}" if bridge.ok else bridge.found
    look_alike = [sys.executable, "-m", "mi_ntf", "render"]
    return look_alike, f"rendered by `mi-ntf render`, since the bridge is missing ({reason})"


def environment() -> dict[str, str]:
    """Return the environment variables of timed processes: their cache of fields and maps is off."""
    return {**os.environ, "MI_NTF_CACHE": "off"}


def render(command: list[str], scene: Path, light: str, visibility: str, spp: int, size: int, out: Path,
           repeats: int = 1) -> Shot:
    """Render `size`² pixels in a process of its own, `repeats` times.

    Raises MiNtfError with the end of the output if it fails.
    """
    defined = (f"light={light}", f"visibility={visibility}", f"spp={spp}", f"res={size}")
    words = [*command, "-m", "llvm_ad_rgb", *(w for d in defined for w in ("-D", d)), "-o", str(out), str(scene)]
    seconds = []
    for _ in range(repeats):
        out.unlink(missing_ok=True)
        start = time.perf_counter()
        try:
            done = subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=TIMEOUT,
                                  check=False)
        except subprocess.TimeoutExpired:
            raise MiNtfError(f"{' '.join(words)}\ndid not end within {TIMEOUT} s; "
                             "try fewer samples (--spp, --environment-spp)") from None
        seconds.append(time.perf_counter() - start)
        if done.returncode or not out.is_file():
            raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; its output ends with\n"
                             f"{(done.stdout + done.stderr)[-4000:]}\n`mi-ntf doctor` looks for the cause")
    return Shot(light, visibility, seconds, read_image(out))


def study(command: list[str], scene: Path, out: Path, budget: str, size: int, spp: int) -> dict[str, Any]:
    """Run `mi-ntf tradeoff` on a scene under its environment map, and return what ``tradeoff.json`` holds.

    Parameters
    ----------
    command
        Program and arguments that stand for `mi-ntf`.
    scene, size, spp
        The scene file, its pixels along a side, and samples a pixel.
    out
        Folder of the report. Findings of an earlier study there are removed, since their seconds are not those of this
        run.
    budget
        Time of the study, such as 120s.

    Raises
    ------
    MiNtfError
        If the study or each of its ways to render fails.
    """
    from mi_ntf.evaluate.kept import NAME

    if (out / NAME).is_file():
        print(f"{out}: the findings of an earlier study are removed, the demo measures anew", file=sys.stderr)
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
        raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; its messages are above")
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    rows = result["ways"]
    if rows and not any(row["points"] for row in rows):
        raise MiNtfError(f"every way of the study failed, the first one since {rows[0]['reason']}; see {out}")
    return result


def demo(out: Path = Path("out/demo"), scene: str = "statue", size: int = 256, spp: int = 16,
         environment_spp: int = 4, budget: str = "120s", repeats: int = 1, results: bool = False) -> None:
    """Render a shipped scene in three visibilities under two lights and compare; then study what accuracy costs.

    Args:
        out: folder for images, table, picture and the study's report.
        scene: name of a folder of scenes/, or the path of another that holds the same files.
        size: pixels along a side, a divisor of the references' 256.
        spp: samples per pixel under the point light.
        environment_spp: the same under the environment map.
        budget: time of the study of the scene under its environment map, such as 90s or 5m.
        repeats: renders of each picture, for the spread of seconds.
        results: write benchmarks/results/demo.json, from three renders of each picture.
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
    console, start = Console(), time.perf_counter()
    console.print(f"{folder / 'scene.xml'}: {note}")
    shots = _shots(command, folder, out, size, {"point": spp, "env": environment_spp}, RECORDED if results else repeats,
                   console)
    text, measured = report(out, shots, references, note)
    print(text)
    if results:
        values = {"scene": scene, "size": size, "spp": spp, "environment_spp": environment_spp, "rows": measured}
        record.write("demo", values, start)
    path = out / "comparison.png"
    console.print(f"picture: {path}; the study of what accuracy costs follows, {budget}", soft_wrap=True)
    try:
        result = study([sys.executable, "-m", "mi_ntf"], folder / "scene.xml", out / "tradeoff", budget, size,
                       environment_spp)
    except MiNtfError as error:
        raise MiNtfError(f"the study failed; table and picture of the renders are in {out}, without its curves\n{error}"
                         ) from None
    picture(path, shots, references, measured, result)
    console.print(f"picture, now with the study: {path}\nstudy: {out / 'tradeoff' / 'index.html'}", soft_wrap=True)


def _shots(command: list[str], folder: Path, out: Path, size: int, samples: dict[str, int], repeats: int,
           console: Any) -> list[Shot]:
    """Render the scene in `folder` under all lights by all methods; `samples` are per pixel, by light."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    shots = []
    with Progress(TextColumn("{task.description:36}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
                  TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("", total=len(LIGHTS) * len(VISIBILITIES))
        for light in LIGHTS:
            for visibility in VISIBILITIES:
                progress.update(task, description=f"{light} · {visibility}")
                file = out / f"{folder.name}_{light}_{visibility}.exr"
                shots.append(render(command, folder / "scene.xml", light, visibility, samples[light], size, file,
                                    repeats))
                progress.advance(task)
    return shots


def _reference(folder: Path, light: str, size: int) -> np.ndarray:
    """Return the path-traced meshes, means of whole pixels where `size` is smaller than that of the file."""
    path = folder / f"reference_{light}.exr"
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; make it with `python scenes/make_references.py {folder.name}`")
    image = read_image(path)
    if not 16 <= size <= len(image) or len(image) % size:
        raise MiNtfError(f"size is {size}, expected a divisor of the reference's {len(image)} pixels, at least 16")
    block = len(image) // size
    result: np.ndarray = image.reshape(size, block, size, block, -1).mean((1, 3))
    return result


def report(out: Path, shots: list[Shot], references: dict[str, np.ndarray], note: str) -> tuple[str, Rows]:
    """Measure `shots` against `references` by light; write ``table.md``, ``metrics.json`` and ``comparison.png``.

    Returns the table and the figures of each shot, which :func:`picture` takes. Raises MiNtfError where the sizes of a
    shot and its reference differ.
    """
    marched = {s.light: s.image for s in shots if s.visibility == "raymarch"}
    for shot in shots:
        if shot.image.shape != references[shot.light].shape:
            raise MiNtfError(f"{shot.light}/{shot.visibility} has shape {shot.image.shape}, its reference "
                             f"{references[shot.light].shape}; make the reference anew at the scene's size")
    measured = [s.measure(references[s.light], marched[s.light]) for s in shots]
    text = (f"Whole-process seconds on {os.cpu_count()} cores, start and compilation included, maps made anew; "
            f"{note}. Reference: the original meshes, path-traced. Metrics: `mi_ntf/evaluate/metrics.py`.\n\n"
            f"{tables.demo_rows(measured, full=True)}\n")
    files.write(out / "table.md", text)
    files.write(out / "metrics.json", json.dumps(measured, indent=1) + "\n")
    picture(out / "comparison.png", shots, references, measured)
    return text, measured


def picture(path: Path, shots: list[Shot], references: dict[str, np.ndarray], measured: Rows,
            study: dict[str, Any] | None = None) -> None:
    """Draw the references and the shots by light, the error maps |a − b|/RMS(b) below them, and the curves of `study`.

    `study` is what ``tradeoff.json`` holds.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    columns = 1 + max(sum(s.light == light for s in shots) for light in references)
    width, height = 3.1 * columns, 6.6 * len(references)
    below = CURVE_HEIGHT if study else 0.0
    figure = Figure(figsize=(width, height + below), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(height, below)) if study else (figure,)
    axes = parts[0].subplots(2 * len(references), columns, squeeze=False)
    for a in axes.flat:
        a.set_axis_off()
    for row, (light, reference) in enumerate(references.items()):
        top, bottom = axes[2 * row], axes[2 * row + 1]
        top[0].imshow(srgb(reference[..., :3]))
        top[0].set_title(f"{LIGHTS[light]}\nreference: path-traced meshes", fontsize=9)
        rms = np.sqrt(np.mean(np.square(reference[..., :3])))
        pairs = [(s, m) for s, m in zip(shots, measured, strict=True) if s.light == light]
        for column, (shot, m) in enumerate(pairs, 1):
            top[column].imshow(srgb(shot.image[..., :3]))
            top[column].set_title(f"{shot.visibility}\n{m['seconds']['median']:.1f} s · SSIM {m['ssim']:.3f}",
                                  fontsize=9)
            error = np.abs(shot.image - reference)[..., :3].mean(-1) / rms
            bottom[column].imshow(error, cmap="inferno", vmin=0, vmax=ERROR_SCALE)
            bottom[column].set_title(f"relative RMSE {m['relative_rmse']:.1%}, "
                                     f"to raymarch {m['relative_rmse_to_raymarch']:.1%}", fontsize=9)
        scale = ScalarMappable(Normalize(0, ERROR_SCALE), "inferno")
        parts[0].colorbar(scale, cax=bottom[0].inset_axes([0.7, 0.1, 0.06, 0.8]), label="error / RMS of the reference")
    if study:
        curves(parts[1], study)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def curves(part: Any, study: dict[str, Any]) -> None:
    """Draw the curves of `study` with a title onto an empty `part` of a matplotlib figure."""
    from mi_ntf.evaluate.tradeoff.report import unsteady

    axes = part.subplots()
    count, (width, height) = sum(bool(row["points"]) for row in study["ways"]), study["size"]
    if count:
        draw(axes, study)
    else:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no way was measured: a larger --budget measures some", ha="center", fontsize=11)
    noisy = ". The machine was noisy" if unsteady(study) else ""
    axes.set_title(f"{LIGHTS['env']}: what accuracy costs, {count} ways to render {width}×{height} pixels, held "
                   f"against the converged field{noisy}", fontsize=11)


def main() -> int:
    """Run the command line and return the exit code."""
    import tyro

    try:
        tyro.cli(demo, prog="python -m benchmarks.demo")
    except MiNtfError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
