"""The figure of ``mi-ntf bench``: time over the number of lights, and the speed-up over a transmittance volume (as the
speed-up curve of Shafiei et al. 2021)."""

from pathlib import Path

import numpy as np

from mi_ntf.core import files

from .bench_paper import LIGHTS


def draw(report: dict, path: Path) -> None:
    """Write the figure of a report of :func:`benchmarks.bench.bench` as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    details = [r["details"] for r in report["rows"]]
    _times(left, next(d for d in details if "intercept_seconds" in d))
    _speed_up(right, [r for r in report["rows"] if "volume_lights_seconds" in r["details"]])
    lines = right.get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower right", fontsize=7, ncols=2)  # among the curves it would hide some
    with files.replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _times(axes, measured: dict) -> None:
    lights, seconds = measured["lights"], measured["seconds"]
    slope = np.polyfit(lights, seconds, 1)[0]
    reach = np.array([0, max(lights)])
    axes.plot(reach, measured["intercept_seconds"] + slope * reach, color="0.6", label="linear fit")
    axes.plot(lights, seconds, "o", label="measured")
    axes.set(xlabel="lights", ylabel="seconds", ylim=(0, None), title="whole image, shipped field, transmittance_map")
    axes.legend()


def _speed_up(axes, rows: list[dict]) -> None:
    lights = np.unique(np.geomspace(1, LIGHTS, 60).astype(int))
    for r in rows:
        d = r["details"]
        volume, tmap = (d[k + "_fixed_seconds"] + lights * d[k + "_lights_seconds"] for k in ("volume", "map"))
        axes.plot(lights, volume / tmap, label=r["what"].split(", ", 2)[2].replace("volume over map, ", ""))
    axes.axhline(92.2, color="0.6", linestyle=":", label="the paper's 92 at 500 lights")
    axes.set(xlabel="lights", yscale="log", ylabel="times faster", title="whole image, volume over map (extrapolated)")
