"""`make demo`: the stock `mitsuba` program renders the shipped scene three ways; a table and a picture show the
outcome.

    python -m mi_ntf.evaluate.demo [--out out/demo] [--scene statue] [--size 256] [--spp 16] [--environment-spp 4]

Writes to `out`: one EXR a render, ``table.md``, ``metrics.json``, ``comparison.png``. Exit code 1 if a render fails.
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError

from .compare import compare_arrays, read_image
from .metrics import relative_rmse, srgb

LIGHTS = {"point": "point light", "env": "environment map"}
VISIBILITIES = ("raymarch", "neural_transmittance", "transmittance_map")
TIMEOUT = 600
"""Seconds after which one render counts as hung."""
ERROR_SCALE = 0.5
"""Upper end of the error maps, in units of the reference's RMS."""


@dataclass(frozen=True)
class Shot:
    """One render. `image`: linear RGBA (h, w, 4); `seconds`: wall time of the whole process, start included."""

    light: str
    visibility: str
    seconds: float
    image: np.ndarray

    def measure(self, reference: np.ndarray, marched: np.ndarray) -> dict:
        """JSON of this shot: :func:`.compare.compare_arrays` to the path-traced meshes, relative RMSE to `raymarch`."""
        return {"light": self.light, "visibility": self.visibility, "seconds": round(self.seconds, 2),
                **compare_arrays(self.image[..., :3], reference[..., :3], reference[..., 3]),
                "relative_rmse_to_raymarch": relative_rmse(self.image[..., :3], marched[..., :3])}


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


def render(command: list[str], scene: Path, light: str, visibility: str, spp: int, size: int, out: Path) -> Shot:
    """Run one render of `size`² pixels as a process of its own. Raises :class:`MiNtfError` with the end of its output
    if it fails."""
    chosen = (f"light={light}", f"visibility={visibility}", f"spp={spp}", f"res={size}")
    defines = [w for d in chosen for w in ("-D", d)]
    words = [*command, "-m", "llvm_ad_rgb", *defines, "-o", str(out), str(scene)]
    start = time.perf_counter()
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        raise MiNtfError(f"{' '.join(words)}\ndid not end within {TIMEOUT} s; "
                         "try fewer samples (--spp, --environment-spp)") from None
    seconds = time.perf_counter() - start
    if done.returncode or not out.is_file():
        raise MiNtfError(f"{' '.join(words)}\nfailed with exit code {done.returncode}; its output ends with\n"
                         f"{(done.stdout + done.stderr)[-4000:]}\n`mi-ntf doctor` looks for the cause")
    return Shot(light, visibility, seconds, read_image(out))


def table(measured: list[dict], note: str) -> str:
    """Markdown table of :meth:`Shot.measure` results."""
    lines = [f"Whole-process seconds on {os.cpu_count()} cores, start and compilation included; {note}. "
             "Reference: the original meshes, path-traced. Metrics: `mi_ntf/evaluate/metrics.py`.", "",
             "| light | visibility | seconds | SSIM | PSNR, dB | HDR-FLIP | relative RMSE | rel. RMSE to `raymarch` |",
             "|---|---|---:|---:|---:|---:|---:|---:|"]
    for m in measured:
        lines.append(f"| {LIGHTS[m['light']]} | `{m['visibility']}` | {m['seconds']:.1f} | {m['ssim']:.3f} | "
                     f"{m['psnr']:.1f} | {m['flip']:.3f} | {m['relative_rmse']:.1%} | "
                     f"{m['relative_rmse_to_raymarch']:.1%} |")
    return "\n".join(lines) + "\n"


def picture(path: Path, shots: list[Shot], references: dict[str, np.ndarray], measured: list[dict]) -> None:
    """Draw, per light, the reference and the shots side by side and beneath them the error maps |a − b|/RMS(b)."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    columns = 1 + max(sum(s.light == light for s in shots) for light in references)
    figure = Figure(figsize=(3.1 * columns, 6.6 * len(references)), layout="constrained")
    axes = figure.subplots(2 * len(references), columns, squeeze=False)
    for a in axes.flat:
        a.set_axis_off()
    for row, (light, reference) in enumerate(references.items()):
        top, bottom = axes[2 * row], axes[2 * row + 1]
        top[0].imshow(srgb(reference[..., :3]))
        top[0].set_title(f"{LIGHTS[light]}\nreference: path-traced meshes", fontsize=9)
        rms = np.sqrt(np.mean(np.square(reference[..., :3])))
        ours = [(s, m) for s, m in zip(shots, measured, strict=True) if s.light == light]
        for column, (shot, m) in enumerate(ours, 1):
            top[column].imshow(srgb(shot.image[..., :3]))
            top[column].set_title(f"{shot.visibility}\n{shot.seconds:.1f} s · SSIM {m['ssim']:.3f}", fontsize=9)
            error = np.abs(shot.image - reference)[..., :3].mean(-1) / rms
            bottom[column].imshow(error, cmap="inferno", vmin=0, vmax=ERROR_SCALE)
            bottom[column].set_title(f"relative RMSE {m['relative_rmse']:.1%}, "
                                     f"to raymarch {m['relative_rmse_to_raymarch']:.1%}", fontsize=9)
        scale = ScalarMappable(Normalize(0, ERROR_SCALE), "inferno")
        figure.colorbar(scale, cax=bottom[0].inset_axes([0.7, 0.1, 0.06, 0.8]), label="error / RMS of the reference")
    with files.replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def report(out: Path, shots: list[Shot], references: dict[str, np.ndarray], note: str) -> str:
    """Measure `shots` against `references` (by light), write ``table.md``, ``metrics.json``, ``comparison.png``.

    Returns the table.
    """
    marched = {s.light: s.image for s in shots if s.visibility == "raymarch"}
    for shot in shots:
        if shot.image.shape != references[shot.light].shape:
            raise MiNtfError(f"{shot.light}/{shot.visibility} has shape {shot.image.shape}, its reference "
                             f"{references[shot.light].shape}; make the reference anew at the scene's size")
    measured = [s.measure(references[s.light], marched[s.light]) for s in shots]
    text = table(measured, note)
    for name, content in [("table.md", text), ("metrics.json", json.dumps(measured, indent=1) + "\n")]:
        files.write(out / name, content)
    picture(out / "comparison.png", shots, references, measured)
    return text


def demo(out: Path = Path("out/demo"), scene: str = "statue", size: int = 256, spp: int = 16,
         environment_spp: int = 4) -> None:
    """Render a shipped scene in three visibilities under two lights and compare.

    Args:
        out: folder for images, table and picture.
        scene: name of a folder of scenes/.
        size: pixels along a side, a divisor of the references' 256.
        spp: samples per pixel under the point light.
        environment_spp: the same under the environment map, whose hundreds of lights each sample pays for.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    folder = Path(__file__).parents[2] / "scenes" / scene
    if not (folder / "scene.xml").is_file():
        raise MiNtfError(f"{folder / 'scene.xml'} does not exist; run the demo in a checkout, on a scene of scenes/")
    references = {light: _reference(folder, light, size) for light in LIGHTS}
    files.make_folder(out)
    command, note = program()
    console = Console()
    console.print(f"{folder / 'scene.xml'}: {note}")
    shots = []
    with Progress(TextColumn("{task.description:36}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
                  TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("", total=len(LIGHTS) * len(VISIBILITIES))
        for light in LIGHTS:
            for visibility in VISIBILITIES:
                progress.update(task, description=f"{light} · {visibility}")
                file = out / f"{folder.name}_{light}_{visibility}.exr"
                file.unlink(missing_ok=True)
                samples = environment_spp if light == "env" else spp
                shots.append(render(command, folder / "scene.xml", light, visibility, samples, size, file))
                progress.advance(task)
    print(report(out, shots, references, note))
    console.print(f"picture: {out / 'comparison.png'}")


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
        tyro.cli(demo, prog="python -m mi_ntf.evaluate.demo")
    except MiNtfError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
