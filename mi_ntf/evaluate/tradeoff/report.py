"""The report of a study: one page that holds all it shows, a table for programs, and JSON."""

import csv
import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ...core import files
from ...data.page import Page, encode
from . import figures
from .reading import busy, error, measured, total
from .search import WORST

WIDTH = 128
"""Pixels along the longer side of a thumbnail, at most."""
BRIGHT = 0.9
"""Level that the brightest 0.5 % of the reference are shown from on."""
SHOWN = 11
"""Pictures of the front, at most."""
ERROR_SCALE = 0.5
"""Upper end of difference images, in units of the reference's RMS."""
COLUMNS = ("number", "front", "label", "build", "render", "total", "repeats", "first", "compile", "peak", "error",
           "noise", "bias", "uncertainty", "mesh_error", "load", "why", "reason")
"""Of the CSV file, before the dials."""

_STYLE = """<style>
#curve { position: relative; } svg { max-width: 100%; height: auto; color: inherit; } svg text { fill: #7d7d7d; }
#card { position: fixed; display: none; background: var(--page); color: var(--ink); border: 1px solid #8888;
        padding: 8px; border-radius: 6px; box-shadow: 0 4px 18px #0005; pointer-events: none; z-index: 9;
        max-width: 300px; font-size: 13px; }
#card img { display: inline-block; width: 140px; image-rendering: pixelated; margin-right: 6px; }
table.points td, table.points th { white-space: nowrap; font-size: 13px; } tr.front { font-weight: 600; }
table.points td:nth-child(2) { white-space: normal; min-width: 17em; }
.wide { overflow-x: auto; } g[id^="p"] { cursor: pointer; }
</style>"""
_SCRIPT = """<div id="card"></div><script>
const points = JSON.parse(document.getElementById("points").textContent), card = document.getElementById("card");
function show(number, event) {
  const p = points[number];
  card.innerHTML = `<img alt="" src="${p.image}"><img alt="" src="${p.difference}">`;
  for (const line of p.lines) { const d = document.createElement("div"); d.textContent = line; card.append(d); }
  card.style.display = "block";
  const box = card.getBoundingClientRect();
  card.style.left = Math.max(4, Math.min(event.clientX + 16, innerWidth - box.width - 8)) + "px";
  card.style.top = Math.max(4, Math.min(event.clientY + 16, innerHeight - box.height - 8)) + "px";
}
for (const number of Object.keys(points)) {
  for (const mark of document.querySelectorAll(`#p${number}, tr[data-point="${number}"]`)) {
    mark.addEventListener("mousemove", event => show(number, event));
    mark.addEventListener("mouseleave", () => { card.style.display = "none"; });
  }
}
</script>"""


def write(result: dict[str, Any], study, out: Path) -> None:
    """``index.html``, ``tradeoff.csv`` and ``tradeoff.json`` in `out`. `study`: the
    :class:`mi_ntf.evaluate.tradeoff.study.Study` that `result` is of."""
    files.write(out / "tradeoff.json", json.dumps(result, indent=1) + "\n")
    files.write(out / "tradeoff.csv", table(result))
    reference = study.reference.image
    pictures = {row["number"]: image for row in measured(result["points"])
                if (image := study.state.image(row["image"])) is not None}
    files.write(out / "index.html", page(result, reference, pictures))


def table(result: dict[str, Any]) -> str:
    """CSV: a line a point, seconds, bytes and relative errors."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *result["base"]])
    for row in result["points"]:
        values = {**row, "total": "" if row["reason"] else total(row), "front": int(row["front"])}
        writer.writerow([*(values.get(name, "") for name in COLUMNS), *row["point"].values()])
    for row in result["skipped"]:
        writer.writerow([*(row.get(name, "") for name in COLUMNS), *row["point"].values()])
    return text.getvalue()


def page(result: dict[str, Any], reference: np.ndarray, pictures: dict[int, np.ndarray]) -> str:
    """HTML. `reference`, `pictures` by number: (h, w, 3) linear."""
    rows, found = result["points"], Page(f"What accuracy costs: {result['scene']}")
    found.markup(_STYLE)
    if not result["finished"]:
        found.warning("The study was interrupted: the same command goes on.")
    if warning := busy(rows, os.cpu_count() or 1):
        found.warning(warning)
    for sentence in result["reading"]:
        found.text(sentence)
    if measured(rows):
        _curves(found, rows, reference, pictures)
    found.section("All points")
    found.text("By seconds; the front in bold. A picture takes build + render; its first one in a process takes the "
               "compilation of kernels besides, or their fetching from Dr.Jit's cache. Bias in brackets is not told "
               "from none.")
    _table(found, rows, "mesh_error" in next(iter(measured(rows)), {}))
    if result["skipped"]:
        found.table(["not measured", "why"], [[s["label"], s["reason"]] for s in result["skipped"]])
    _references(found, result)
    return found.html()


def _curves(found: Page, rows, reference, pictures) -> None:
    found.section("Error over time")
    found.text("Left and below is better. Thin lines join points that differ in samples a pixel alone. Point at a mark "
               "for its picture and its difference from the reference.")
    found.markup(f'<div id="curve">{figures.curve(rows)}</div>')
    thumbs = _Thumbnails(reference)
    points = {row["number"]: {"image": encode(thumbs.picture(pictures[row["number"]])),
                              "difference": encode(thumbs.difference(pictures[row["number"]])), "lines": _lines(row)}
              for row in measured(rows) if row["number"] in pictures}
    content = json.dumps(points).replace("</", "<\\/")
    found.section("The front in pictures")
    found.text(f"Below each its difference from the reference: white is {ERROR_SCALE:.0%} of the reference's RMS or "
               "more.")
    shown: list[tuple] = [("reference", encode(thumbs.picture(reference)), None)]
    ends = [row for row in rows if row["front"] and row["number"] in points]
    ends = [row for row in ends if row["error"] < WORST] or ends
    kept = np.unique(np.linspace(0, len(ends) - 1, min(SHOWN, len(ends))).round().astype(int))
    shown += [(f"{row['number']}: {row['label']}: {total(row):.3g} s, {row['error']:.1%}",
               points[row["number"]]["image"], points[row["number"]]["difference"]) for row in (ends[k] for k in kept)]
    found.markup('<div class="row">' + "".join(map(_figure, *zip(*shown, strict=True))) + "</div>")
    found.section("Bias at equal noise")
    found.text("What no number of samples takes away. Open triangles: not told from none, the bound of two standard "
               "errors.")
    found.markup(f"<div>{figures.bias_curve(rows)}</div>")
    found.markup(f'<script type="application/json" id="points">{content}</script>{_SCRIPT}')


def _figure(caption: str, image: str, difference: str | None) -> str:
    below = f'<img class="small" width="{WIDTH}" src="{difference}" alt="difference">' if difference else ""
    return (f'<figure style="width:{WIDTH + 24}px"><img class="small" width="{WIDTH}" src="{image}" alt="">{below}'
            f"<figcaption>{escape(caption)}</figcaption></figure>")


def _lines(row: dict[str, Any]) -> list[str]:
    """What the card of a point says."""
    lines = [f"{row['number']}: {row['label']}",
             f"{total(row):.3g} s: build {row['build']:.2g}, render {row['render']:.3g}; "
             f"compilation {row['compile']:.2g} s",
             f"error {row['error']:.1%}: noise {row['noise']:.1%}, bias {_bias(row)}",
             f"{row['peak'] / 2**20:.0f} MiB"]
    return lines + ([f"error to the mesh {row['mesh_error']:.1%}"] if "mesh_error" in row else [])


def _bias(row: dict[str, Any]) -> str:
    text = f"{row['bias']:.1%}"
    return text if error(row).known else f"({text})"


def _table(found: Page, rows: list[dict[str, Any]], mesh: bool) -> None:
    header = ["", "point", "build s", "render s", "of", "compile s", "MiB", "error", "noise", "bias",
              *(["to mesh"] if mesh else [])]
    lines = ["<tr>" + "".join(f"<th>{h}</th>" for h in header) + "</tr>"]
    for row in rows:
        cells = [row["number"], row["label"]]
        if row["reason"]:
            text = f'<td colspan="{len(header) - 2}" style="white-space:normal">failed: {escape(row["reason"])}</td>'
        else:
            figures_ = [f"{row['build']:.2f}", f"{row['render']:.3g}", row["repeats"], f"{row['compile']:.2g}",
                        f"{row['peak'] / 2**20:.0f}", f"{row['error']:.1%}", f"{row['noise']:.1%}", _bias(row)]
            figures_ += [f"{row['mesh_error']:.1%}"] if mesh else []
            text = "".join(f"<td>{escape(str(value))}</td>" for value in figures_)
        mark = ' class="front"' if row["front"] else ""
        lines.append(f'<tr{mark} data-point="{row["number"]}">'
                     + "".join(f"<td>{escape(str(c))}</td>" for c in cells) + text + "</tr>")
    found.markup('<div class="wide"><table class="points">' + "\n".join(lines) + "</table></div>")


def _references(found: Page, result: dict[str, Any]) -> None:
    """What errors are held against, how far that can be trusted, and what computed."""
    found.section("References and machine")
    known = result["references"]
    if reference := known.get("reference"):
        found.text(f"Errors are relative RMSE to the converged field: {reference['about']}. Its own noise is "
                   f"{reference['noise']:.2%}, which is taken off the errors.")
    if check := known.get("check"):
        found.text(check["verdict"])
    if mesh := known.get("mesh"):
        found.text(f"“To mesh” is the error to the path-traced mesh, all that is lost: {mesh['about']}.")
    machine = result["machine"]
    found.text(result["picture"])
    found.text(f"{machine['what']}; Mitsuba {machine['mitsuba']}, mi_ntf {machine['version']}. The study took "
               f"{result['spent_seconds']:.0f} s of {result['budget_seconds']:.0f} s. “of”: how many warm renderings "
               "the median is of.")


class _Thumbnails:
    """Small pictures, all shown alike."""

    def __init__(self, reference: np.ndarray):
        self._reference = _small(reference)
        self._scale = BRIGHT / max(float(np.percentile(reference.max(-1), 99.5)), 1e-12)
        self._rms = max(float(np.sqrt(np.mean(np.square(reference, dtype=np.float64)))), 1e-12)

    def picture(self, image: np.ndarray) -> np.ndarray:
        """Linear RGB, as bright as the page shows it."""
        return np.clip(_small(image) * self._scale, 0, 1)

    def difference(self, image: np.ndarray) -> np.ndarray:
        """sRGB levels of |image − reference|."""
        from matplotlib import colormaps

        wrong = np.abs(_small(image) - self._reference).mean(-1) / self._rms
        return (255 * colormaps["inferno"](np.clip(wrong / ERROR_SCALE, 0, 1))[..., :3]).astype(np.uint8)


def _small(image: np.ndarray) -> np.ndarray:
    """At most `WIDTH` pixels along the longer side, means of squares."""
    block = -(-max(image.shape[:2]) // WIDTH)
    h, w = (n // block * block for n in image.shape[:2])
    return image[:h, :w].reshape(h // block, block, w // block, block, 3).mean((1, 3))


@contextmanager
def progress(budget: float, quiet: bool = False) -> Iterator:
    """Shows how far a study is, on stderr; gives the function that hears seconds, a text, and
    whether that is done, which is a line that stays."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True, quiet=quiet)
    columns = (TextColumn("{task.completed:.0f} of {task.total:.0f} s"), BarColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=budget)

        def tell(seconds: float, text: str, done: bool) -> None:
            bar.update(task, completed=min(seconds, budget), description=escape_markup(text))
            if done:
                console.print(f"{seconds:5.0f} s  {text}", highlight=False, markup=False, soft_wrap=True)

        yield tell


def escape_markup(text: str) -> str:
    """`text` for rich, which takes brackets for markup."""
    from rich.markup import escape as escape_rich

    return escape_rich(text)


def print_table(result: dict[str, Any]) -> None:
    """The result for a reader."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console = console if console.is_terminal else Console(width=130)
    table = Table("", "point", "build s", "render s", "error", "noise", "bias")
    for row in result["points"]:
        if row["reason"]:
            table.add_row(str(row["number"]), f"{row['label']}: failed, {row['reason']}")
            continue
        name = row["label"] + (" *" if row["front"] else "")
        table.add_row(str(row["number"]), name, f"{row['build']:.2f}", f"{row['render']:.3g}", f"{row['error']:.1%}",
                      f"{row['noise']:.1%}", _bias(row))
    console.print(table)
    console.print("*: on the front. Bias in brackets is not told from none.", highlight=False)
    for sentence in result["reading"]:
        console.print(sentence, highlight=False, markup=False)
