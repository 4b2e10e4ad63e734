"""Table and picture of the demo."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.compare import compare_arrays
from mi_ntf.evaluate.curves import draw
from mi_ntf.evaluate.metrics import relative_rmse, srgb

LIGHTS = {"point": "point light", "env": "environment map"}
ERROR_SCALE = 0.5
"""Upper end of the error maps, in units of the reference's RMS."""
CURVE_HEIGHT = 4.8
"""Inches of the study's curves, where a picture is 3.1 wide."""


@dataclass(frozen=True)
class Shot:
    """A render. `image`: linear RGBA (h, w, 4); `seconds`: wall time of the whole process, start included."""

    light: str
    visibility: str
    seconds: float
    image: np.ndarray

    def measure(self, reference: np.ndarray, marched: np.ndarray) -> dict:
        """JSON of this shot: :func:`.compare.compare_arrays` to the path-traced meshes, relative RMSE to `raymarch`."""
        return {"light": self.light, "visibility": self.visibility, "seconds": round(self.seconds, 2),
                **compare_arrays(self.image[..., :3], reference[..., :3], reference[..., 3]),
                "relative_rmse_to_raymarch": relative_rmse(self.image[..., :3], marched[..., :3])}


def table(measured: list[dict], note: str) -> str:
    """Markdown table of :meth:`Shot.measure` results."""
    lines = [f"Whole-process seconds on {os.cpu_count()} cores, start and compilation included, maps made anew; "
             f"{note}. Reference: the original meshes, path-traced. Metrics: `mi_ntf/evaluate/metrics.py`.", "",
             "| light | visibility | seconds | SSIM | PSNR, dB | HDR-FLIP | relative RMSE | rel. RMSE to `raymarch` |",
             "|---|---|---:|---:|---:|---:|---:|---:|"]
    for m in measured:
        lines.append(f"| {LIGHTS[m['light']]} | `{m['visibility']}` | {m['seconds']:.1f} | {m['ssim']:.3f} | "
                     f"{m['psnr']:.1f} | {m['flip']:.3f} | {m['relative_rmse']:.1%} | "
                     f"{m['relative_rmse_to_raymarch']:.1%} |")
    return "\n".join(lines) + "\n"


def picture(path: Path, shots: list[Shot], references: dict[str, np.ndarray], measured: list[dict],
            study: dict | None = None) -> None:
    """Draw, per light, the reference and the shots side by side and beneath them the error maps |a − b|/RMS(b); below
    all of it the curves of `study`, what ``tradeoff.json`` holds."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    columns = 1 + max(sum(s.light == light for s in shots) for light in references)
    width, height = 3.1 * columns, 6.6 * len(references)
    below = CURVE_HEIGHT if study else 0.0
    figure = Figure(figsize=(width, height + below), layout="constrained")
    found: Any = figure.subfigures(2, 1, height_ratios=(height, below)) if study else (figure,)
    upper = found[0]
    axes = upper.subplots(2 * len(references), columns, squeeze=False)
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
        upper.colorbar(scale, cax=bottom[0].inset_axes([0.7, 0.1, 0.06, 0.8]), label="error / RMS of the reference")
    if study:
        curves(found[1], study)
    with files.replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def curves(part, study: dict) -> None:
    """Draw the curves of `study` onto an empty `part` of a matplotlib figure, under a title that says what they are of.
    """
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


def report(out: Path, shots: list[Shot], references: dict[str, np.ndarray], note: str) -> tuple[str, list[dict]]:
    """Measure `shots` against `references` (by light), write ``table.md``, ``metrics.json``, ``comparison.png``.

    Returns the table and the figures of each shot, which :func:`picture` takes. Raises MiNtfError where a shot and its
    reference differ in size.
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
    return text, measured
