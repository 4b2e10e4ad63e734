"""The report of a study: a page with the figure of curves, a table for programs, and JSON."""

import csv
import io
import json
import re
from html import escape
from pathlib import Path
from typing import TypeAlias

import numpy as np

from ...core import files
from ...core.quantities import duration
from ...data.images import levels
from ...data.page import Page, new_figure, plain
from ..curves import draw
from ..limits import Json
from . import errors
from .measure import TIMES
from .references import ERRORS
from .ways import BOUND, MESH, STOCK

SPREAD = 0.1
"""Relative standard deviation of equal renders above which a machine is noisy, as in pyperf."""
Pictures: TypeAlias = dict[str, dict[str, np.ndarray]]
"""Pictures of each way by the seconds after which they are compared."""
COLUMNS = ("seconds", "samples", "error", "error_uncertainty", "noise", "noise_uncertainty", "bias", "bias_uncertainty",
           "mesh_error", "mesh_error_uncertainty", "front")
HEADER = ("way", *(f"to {limit:.0%}" for limit in ERRORS), "error at the end", "after", "samples", "noise", "bias",
          "to the mesh")


def write(result: Json, reference: np.ndarray, pictures: Pictures, out: Path) -> None:
    """Write ``index.html``, ``tradeoff.csv`` and ``tradeoff.json`` to `out`.

    `result` is that of the study, and `reference` its linear picture (h, w, 3).
    """
    files.write(out / "tradeoff.json", json.dumps(result, indent=1) + "\n")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["way", "method", *COLUMNS, "reason"])
    for row in result["ways"]:
        for point in row["points"] or [{}]:
            writer.writerow([row["title"], row["method"], *(point.get(name) for name in COLUMNS), row["reason"]])
    files.write(out / "tradeoff.csv", text.getvalue())
    page(result, reference, pictures).write(out / "index.html")


def page(result: Json, reference: np.ndarray, pictures: Pictures) -> Page:
    """Return the page of :func:`write`."""
    sheet = Page(f"What accuracy costs: {result['title']}")
    if not result["finished"]:
        sheet.warning("The study was interrupted. The page shows its results so far. The same command continues it.")
    if noisy := unsteady(result):
        sheet.warning(noisy)
    if any(row["points"] for row in result["ways"]):
        sheet.section("Error over time")
        sheet.text("Each curve is one way to render the scene, with more samples from left to right. Lower is better. "
                   "Seconds include the making of maps and exclude the compilation of kernels. Bands are one standard "
                   "error wide. The thick grey line, the Pareto front, joins the least errors of each time. Rendering "
                   "without shadows is a bound: the error without any visibility.")
        figure = new_figure(10.5, 5.2)
        axes = figure.add_subplot()
        plain(axes)
        draw(axes, result)
        sheet.drawing(figure, "Error over seconds, one curve for each way to render", 760)
    sheet.section("Seconds to an error")
    sheet.text("Brackets hold the range of the time, since errors are estimates, ± one standard error. Nothing is "
               "extrapolated: where an error is not reached, the time of that way ended before. More samples reduce "
               "noise; bias remains.")
    lines = ["".join(f"<th>{h}</th>" for h in HEADER)]
    for row in result["ways"]:
        lines.append("".join(f'<td style="white-space: nowrap">{escape(cell)}</td>' for cell in cells(row)))
        if row["points"]:
            lines.append(f'<td colspan="{len(HEADER)}">{_recipe(row)}</td>')
    table = "".join(f"<tr>{line}</tr>\n" for line in lines)
    sheet.scrolling(f'<table style="font-size: 13px">{table}</table>', "Seconds to an error")
    _pictures(sheet, result, reference, pictures)
    _about(sheet, result)
    return sheet


def unsteady(result: Json) -> str:
    """Return a warning if equal renders took unequal times, else an empty string."""
    spread, probes = result["machine"]["spread"], result["machine"]["probe_seconds"]
    if not spread or spread <= SPREAD:
        return ""
    return (f"The machine was noisy: the same small render took {duration(min(probes))} to {duration(max(probes))}, a "
            f"standard deviation of {spread:.0%}. All seconds are uncertain by as much. Repeat the study while "
            "nothing else runs.")


def cells(row: Json) -> list[str]:
    """Return the cells of a way below `HEADER`, or its name and the reason if it failed."""
    if not row["points"]:
        return [row["title"], f"failed: {row['reason']}"]
    seconds, end = [p["seconds"] for p in row["points"]], row["points"][-1]

    def reached(limit: float) -> str:
        middle, early, late = (errors.crossing(seconds, [p["error"] + step * p["error_uncertainty"]
                                                         for p in row["points"]], limit) for step in (0, -1, 1))
        if middle is None:
            return "not reached"
        times = ["not reached" if time is None else duration(time) for time in (early, late)]
        bound = "at most " if middle == seconds[0] else ""
        return f"{bound}{duration(middle)}" + (f" ({times[0]} to {times[1]})" if times[0] != times[1] else "")

    def estimate(name: str) -> str:
        value = end.get(name)
        return "not known" if value is None else f"{value:.1%} ± {end[f'{name}_uncertainty']:.1%}"

    name = row["title"] + (" (a bound)" if row["method"] == BOUND else "")
    return [name, *map(reached, ERRORS), estimate("error"), duration(end["seconds"]), f"{end['samples']}",
            *map(estimate, ("noise", "bias", "mesh_error"))]


def _recipe(row: Json) -> str:
    """Return HTML with the scene file's element and the command that render a way."""
    shapes = " and the shapes around the fields" if row["method"] == MESH else ""
    text = Page.code(row["xml"], f"In the scene file, in place of its integrator{shapes}:")
    text += Page.code(row["command"], "On the command line:") if row["command"] else ""
    note = f"<p>{escape(row['note'])}</p>" if row["note"] else ""
    return f"<details><summary>How to render by {escape(row['title'])}</summary>{note}{text}</details>"


def _pictures(sheet: Page, result: Json, reference: np.ndarray, pictures: Pictures) -> None:
    """Add the pictures after equal times of the ways that rendered for half of it or more, and the differences."""
    from matplotlib import colormaps

    scale = 0.9 / max(float(np.percentile(reference.max(-1), 99.5)), 1e-12)
    rms = max(float(np.sqrt(np.mean(np.square(reference, dtype=np.float64)))), 1e-12)
    sheet.section("Equal time")
    sheet.text("The picture of each way after the same time, and below it the difference from the reference: white is "
               "half of the reference's root mean square, or more. Ways that had no picture by then, or ended well "
               "before, are left out.")
    sheet.pictures([("reference", levels(reference * scale))], 144)
    for mark in TIMES:
        pairs = []
        for row in result["ways"]:
            image = pictures[row["way"]].get(str(mark))
            if image is None or not row["points"] or 2 * row["points"][-1]["seconds"] < mark:
                continue
            point = [p for p in row["points"] if p["seconds"] <= mark][-1]
            heat = colormaps["inferno"](np.clip(2 * np.abs(image - reference).mean(-1) / rms, 0, 1))[..., :3]
            pairs.append((f"{row['title']}: error {point['error']:.1%} after {duration(point['seconds'])}",
                          np.vstack([levels(image * scale), (255 * heat).astype(np.uint8)])))
        if pairs:
            sheet.markup(f"<h3>After {mark} s</h3>")
            sheet.pictures(pairs, 144)


def _about(sheet: Page, result: Json) -> None:
    """Add the references, the machine, and the ways that were left out."""
    sheet.section("References and machine")
    reference, machine = result["reference"], result["machine"]
    sheet.text("Errors are root mean square differences, relative to the root mean square of the reference: the same "
               f"field by {reference['about']}. Its noise, {reference['noise']:.2%}, is subtracted.")
    sheet.text(check(result))
    if result["mesh"]:
        sheet.text("Errors to the mesh, the object that was captured, include those of the field: "
                   f"{result['mesh']}.")
    (width, height), (whole, _) = result["size"], result["scene_size"]
    if width != whole:
        sheet.text(f"Pictures are {width}×{height} pixels, so that the reference fits into the budget. At the scene's "
                   f"own size a sample takes about {whole ** 2 // width ** 2} times as long, but maps do not.")
    spread = "" if machine["spread"] is None else (
        f" The same small render, {len(machine['probe_seconds'])} times, varied by {machine['spread']:.0%}.")
    sheet.text(f"{machine['what']}, Mitsuba {machine['mitsuba']}. The study took {result['spent_seconds']:.0f} s of "
               f"{result['budget_seconds']:.0f} s.{spread}")
    if result["left_out"]:
        sheet.table(["way"], [[name] for name in result["left_out"]], f"{len(result['left_out'])} finer ways were left "
                    f"out, since the budget has less than {TIMES[-1]} s for each")


def check(result: Json) -> str:
    """Return a sentence on the reference and stock ``volpath``, which do not share code for light."""
    stock = next((row for row in result["ways"] if row["method"] == STOCK and row["points"]), None)
    if stock is None:
        return "The reference was not compared with stock volpath."
    gap, sigma = stock["shift"]
    text = (f"The check of the reference: the mean brightness of stock volpath, after {stock['points'][-1]['samples']} "
            f"samples a pixel, differs from it by {gap:+.2%} ± {sigma:.2%}")
    if sigma > 0.02:
        return f"{text}, too noisy to show differences below {2 * sigma:.0%}."
    return f"{text}, {'no' if abs(gap) < 2 * sigma else 'perhaps a' if abs(gap) < 3 * sigma else 'a'} difference."


def verdict(result: Json) -> str:
    """Return a sentence on the fastest way to the least of the errors of the report that is reached."""
    ways = [row for row in result["ways"] if row["points"] and row["method"] != BOUND]
    for limit in sorted(ERRORS):
        times = {row["title"]: errors.crossing([p["seconds"] for p in row["points"]],
                                               [p["error"] for p in row["points"]], limit) for row in ways}
        reached = {title: seconds for title, seconds in times.items() if seconds is not None}
        if reached:
            title = min(reached, key=lambda title: reached[title])
            return f"{title} is the fastest to an error of {limit:.0%}, after {duration(reached[title])}"
    return f"no way reached an error of {max(ERRORS):.0%}; give a longer --budget"


def print_table(result: Json, out: Path) -> None:
    """Print the seconds to each error, the verdict, and the page in the folder `out`."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(*HEADER[:5], "error", "after", box=SIMPLE_HEAD, pad_edge=False)
    for row in result["ways"]:
        name, *others = cells(row)[:7]
        # The page has the ranges; here they would not fit into a terminal.
        table.add_row(name, *(re.sub(r" \(.*\)| ± .*", "", cell).replace("not reached", "–") for cell in others))
    Console().print(table, unsteady(result))
    print(f"page: {out / 'index.html'}", f"verdict: {verdict(result)}",
          "next: open the page in a browser; it has the recipe of every way", sep="\n")
