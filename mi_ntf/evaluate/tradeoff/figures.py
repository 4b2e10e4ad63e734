"""The curves of a study: of its report, as SVG that stands inside the page, where points have the ids ``p1``, ``p2``, …
of their numbers; and :func:`panel`, the same curve in a figure of others."""

import io
import re
from typing import Any

import numpy as np

from ...data.page import GREY, new_figure, plain
from . import errors
from .points import from_dict, short
from .reading import error, groups, measured, total

COLOURS = ("#3b82e0", "#e0433a", "#2f9e44", "#e39b1a", "#8b5cf6", "#0ea5b7", "#d6409f", "#8a6d3b", "#7d7d7d")
MARKERS = "osD^vPXph"
APART = 14
"""Dots between marks whose numbers do not meet."""
EQUAL_NOISE = 0.05
"""Relative noise at which the second curve compares bias."""


def methods(rows: list[dict[str, Any]]) -> dict[str, tuple[str, str]]:
    """Colour and marker of every method that was measured, by its name."""
    names = sorted({row["point"]["method"] for row in measured(rows)})
    return {name: (COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]) for i, name in enumerate(names)}


def curve(rows: list[dict[str, Any]]) -> str:
    """Error over seconds, the front marked and numbered."""
    figure = new_figure(9.5, 5.2)
    axes = figure.add_subplot()
    plain(axes)
    ends = draw(axes, rows)
    _log(axes, "seconds of a picture, maps made anew, kernels compiled", "relative error of a picture")
    _number(axes, ends)
    axes.legend(frameon=False, labelcolor=GREY, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1))
    return _svg(figure)


def _number(axes, ends: list[dict[str, Any]]) -> None:
    """Numbers of the front `ends`, below and left of their marks; above and right where the one before is near."""
    axes.get_figure(root=True).draw_without_rendering()  # gives axes their size
    below, before = True, np.full(2, -np.inf)
    for row in ends:
        place = total(row), row["error"]
        at = axes.transData.transform(place)
        below = not below if np.abs(at - before).max() < APART else True
        axes.annotate(str(row["number"]), place, xytext=(-6, -11) if below else (6, 5), textcoords="offset points",
                      fontsize=8, color=GREY, ha="right" if below else "left")
        before = at


def panel(axes, result: dict[str, Any], environment: bool, fontsize: float = 11.0) -> None:
    """Draw the curve of ``tradeoff.json`` onto `axes` of a larger figure, the points of the front in words.

    environment  the scene has one, see :func:`.points.short`
    fontsize     points
    """
    base, rows = from_dict(result["base"]), result["points"]
    ends = draw(axes, rows)
    width, height = result["size"]
    _log(axes, f"seconds of a picture of {width}×{height} pixels, maps made anew, kernels compiled",
         "relative error")
    for text in (axes.xaxis.label, axes.yaxis.label, *axes.get_xticklabels(), *axes.get_yticklabels()):
        text.set_fontsize(fontsize)
    axes.tick_params(labelsize=fontsize)
    axes.grid(True, color=GREY, alpha=0.2)
    axes.legend(frameon=False, fontsize=fontsize, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    name_below(axes, [(total(row), row["error"], short(from_dict(row["point"]), base, environment)) for row in ends],
               fontsize)


def draw(axes, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Marks of all measured points, thin lines between those that differ in samples a pixel alone, the front as steps.
    Returns the rows of the front, by seconds."""
    looks = methods(rows)
    for group in groups(rows):
        colour, _ = looks[group[0]["point"]["method"]]
        axes.plot([total(r) for r in group], [r["error"] for r in group], color=colour, alpha=0.35, linewidth=1)
    ends = [row for row in rows if row["front"]]
    axes.plot([total(r) for r in ends], [r["error"] for r in ends], color=GREY, linewidth=2.5, alpha=0.6,
              drawstyle="steps-post", label="Pareto front", zorder=1)
    _points(axes, measured(rows), looks)
    return ends


def name_below(axes, named: list[tuple[float, float, str]], fontsize: float) -> None:
    """Write words beside the points ``(x, y, words)`` of a front on log axes, from its upper left end to its lower
    right one: each to the left and below of its point, where no point is, and below the words before it. The axes
    become as much wider as that takes."""
    if not named:
        return
    figure = axes.get_figure(root=True)
    dot = figure.dpi / 72
    figure.draw_without_rendering()  # gives axes their size
    box = axes.get_window_extent()
    line, gap = 1.25 * fontsize * dot / box.height, 7 * dot
    texts = [axes.annotate(words, (x, y), fontsize=fontsize, ha="right", va="center", zorder=4,
                           bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
                           arrowprops={"arrowstyle": "-", "color": GREY, "linewidth": 0.8, "shrinkB": 4,
                                       "relpos": (1, 0.5)})
             for x, y, words in named]
    widths = [text.get_window_extent().width + 2 * gap for text in texts]
    low, high = np.log10(axes.get_xlim())
    least = [(f * (high - low) - (np.log10(x) - low)) / (1 - f)
             for (x, _, _), f in zip(named, (min(w / box.width, 0.9) for w in widths), strict=True)]
    low -= max(0.0, *least)
    axes.set_xlim(10**low, 10**high)
    bottom, top = np.log10(axes.get_ylim())
    bottom -= (top - bottom) * line * 1.5  # for the words of the lowest point
    places = _stacked([np.log10(y) for _, y, _ in named], bottom, top, line)
    while places[-1] < line and bottom > -12:
        bottom -= 0.1
        places = _stacked([np.log10(y) for _, y, _ in named], bottom, top, line)
    axes.set_ylim(10**bottom, 10**top)
    for (x, _, _), text, place in zip(named, texts, places, strict=True):
        text.set_position(((np.log10(x) - low) / (high - low) - gap / box.width, place))
        text.set_anncoords("axes fraction")


def _stacked(heights: list[float], bottom: float, top: float, line: float) -> list[float]:
    """Heights of words in shares of the axes from `bottom` to `top`, one `line` below their point and below each
    other."""
    places: list[float] = []
    for height in heights:
        place = (height - bottom) / (top - bottom) - 0.8 * line
        places.append(min(place, places[-1] - line) if places else place)
    return places


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
