"""The curves of the report, as SVG that stands inside the page: points have the ids ``p1``, ``p2``, … of their
numbers."""

import io
import re
from typing import Any

from ...data.page import GREY, new_figure, plain
from . import errors
from .reading import error, groups, measured, total

COLOURS = ("#3b82e0", "#e0433a", "#2f9e44", "#e39b1a", "#8b5cf6", "#0ea5b7", "#d6409f", "#8a6d3b", "#7d7d7d")
MARKERS = "osD^vPXph"
EQUAL_NOISE = 0.05
"""Relative noise at which the second curve compares bias."""


def methods(rows: list[dict[str, Any]]) -> dict[str, tuple[str, str]]:
    """Colour and marker of every method that was measured, by its name."""
    names = sorted({row["point"]["method"] for row in measured(rows)})
    return {name: (COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]) for i, name in enumerate(names)}


def curve(rows: list[dict[str, Any]]) -> str:
    """Error over seconds, the front marked."""
    figure = new_figure(9.5, 5.2)
    axes = figure.add_subplot()
    plain(axes)
    looks = methods(rows)
    for group in groups(rows):
        colour, _ = looks[group[0]["point"]["method"]]
        axes.plot([total(r) for r in group], [r["error"] for r in group], color=colour, alpha=0.35, linewidth=1)
    ends = [row for row in rows if row["front"]]
    axes.plot([total(r) for r in ends], [r["error"] for r in ends], color=GREY, linewidth=2.5, alpha=0.6,
              drawstyle="steps-post", label="Pareto front", zorder=1)
    _points(axes, measured(rows), looks)
    for row in ends:
        axes.annotate(str(row["number"]), (total(row), row["error"]), xytext=(-6, -11), textcoords="offset points",
                      fontsize=8, color=GREY, ha="right")
    _log(axes, "seconds of a picture, maps made anew, kernels compiled", "relative error of a picture")
    axes.legend(frameon=False, labelcolor=GREY, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1))
    return _svg(figure)


def bias_curve(rows: list[dict[str, Any]]) -> str:
    """Bias over the seconds that a picture of `EQUAL_NOISE` would take; what may be none as a bound."""
    figure = new_figure(9.5, 3.6)
    axes = figure.add_subplot()
    plain(axes)
    looks, named = methods(rows), set()
    for group in groups(rows):
        last = group[-1]
        seconds = last["build"] + last["render"] * (last["noise"] / EQUAL_NOISE) ** 2
        found = errors.pooled([error(row) for row in group])
        method = last["point"]["method"]
        colour, _ = looks[method]
        axes.scatter([seconds], [found.bias if found.known else found.most], s=34, color=colour,
                     marker="o" if found.known else "v", facecolors=colour if found.known else "none", zorder=3,
                     label=None if method in named else method)
        named.add(method)
    _log(axes, f"seconds of a picture of {EQUAL_NOISE:.0%} noise, reckoned from the samples measured", "bias")
    axes.legend(frameon=False, labelcolor=GREY, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1))
    return _svg(figure)


def _points(axes, rows: list[dict[str, Any]], looks: dict[str, tuple[str, str]]) -> None:
    """One mark each, ringed on the front; the first of a method names it."""
    named = set()
    for row in rows:
        method = row["point"]["method"]
        colour, marker = looks[method]
        mark = axes.scatter([total(row)], [row["error"]], s=60 if row["front"] else 34, color=colour, marker=marker,
                            edgecolors=GREY if row["front"] else "none", linewidths=1.8, zorder=3,
                            label=None if method in named else method)
        mark.set_gid(f"p{row['number']}")
        named.add(method)


def _log(axes, xlabel: str, ylabel: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set(xlabel=xlabel, ylabel=ylabel, xscale="log", yscale="log")
    for axis, text in ((axes.xaxis, lambda v, _: f"{v:g} s"), (axes.yaxis, lambda v, _: f"{100 * v:g} %")):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(text))
        axis.set_minor_formatter(NullFormatter())


def _svg(figure) -> str:
    """The figure as an element of a page: nothing in it names another place."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "mi_ntf", "font.family": "sans-serif"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg"):]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r'\s(xmlns(:\w+)?|width|height)="[^"]*"', "", text[: text.index(">")]) + text[text.index(">"):]
    return text.replace("xlink:href", "href")
