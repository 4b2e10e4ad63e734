"""The figure of `mi-ntf tradeoff` and of `make demo`: error over seconds, one curve for each way to render."""

from typing import TYPE_CHECKING

from ..data.page import GREY
from .limits import Json

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {
    "raymarch": "#3b82e0", "transmittance_map": "#e0433a", "transmittance_atlas": "#2f9e44",
    "neural_transmittance": "#8b5cf6", "ray_network": "#0ea5b7", "transmittance_volume": "#e39b1a",
    "visibility_mlp": "#d6409f", "volpath": "#8a6d3b", "mesh": "#64748b", "none": GREY,
}
"""Colour of each method in every figure."""
DASHES = ((0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)), (0, (9, 3)), (0, (3, 1, 1, 1, 1, 1)))
"""Dashes of the finer dials of a method, in their order."""


def draw(axes: "Axes", result: Json, fontsize: float = 11.0) -> None:
    """Draw the curves of ``tradeoff.json`` onto `axes`, their names beside them, and the Pareto front.

    The band of a curve is one standard error wide. Methods have the colours of `COLOURS`; finer dials of a method have
    different dashes.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ends = sorted((p["seconds"], p["error"]) for row in result["ways"] for p in row["points"] if p.get("front"))
    axes.plot([p[0] for p in ends], [p[1] for p in ends], color=GREY, linewidth=6, alpha=0.35, drawstyle="steps-post",
              zorder=1, label="Pareto front")
    finer: dict[str, int] = {}
    for row in result["ways"]:
        points = [p for p in row["points"] if p["error"] > 0]
        bound, colour = row["method"] == "none", COLOURS.get(row["method"], "#111111")
        dash: str | tuple[int, tuple[float, ...]] = (0, (2, 2)) if bound else "-"
        if row["finer"]:
            count = finer[row["method"]] = finer.get(row["method"], -1) + 1
            dash = DASHES[count % len(DASHES)]
        x, y = [p["seconds"] for p in points], [p["error"] for p in points]
        axes.plot(x, y, linestyle=dash, marker="none" if bound else "o", markersize=4, zorder=2 if bound else 3,
                  label=row["title"] + (" (a bound)" if bound else ""), color=colour, linewidth=1.3 if bound else 2)
        low = [max(p["error"] - p["error_uncertainty"], p["error"] / 2) for p in points]
        axes.fill_between(x, low, [p["error"] + p["error_uncertainty"] for p in points], color=colour,
                          alpha=0.12, linewidth=0)
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("seconds, building included, compilation apart", fontsize=fontsize)
    axes.set_ylabel("relative error", fontsize=fontsize)
    axes.tick_params(labelsize=fontsize, which="both")
    axes.grid(True, color=GREY, alpha=0.2)
    for axis, text in ((axes.xaxis, lambda v, _: f"{v:g} s"), (axes.yaxis, lambda v, _: f"{100 * v:g} %")):
        low_end, high_end = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high_end < 300 * low_end else (1,)))
        axis.set_major_formatter(FuncFormatter(text))
        axis.set_minor_formatter(NullFormatter())
    axes.legend(frameon=False, labelcolor=axes.xaxis.label.get_color(), fontsize=fontsize, loc="upper left",
                bbox_to_anchor=(1.0, 1.0), handlelength=2.6)
