"""The tables of the report, once for HTML and LaTeX: our figures, and the paper's behind them in brackets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..bench_measure import Sizes as BenchSizes
from . import costs as times
from . import paper
from .compared import LIGHTS, METRICS
from .results import BASE, Accuracy, Figure

MISSING = "–"
PAIRS = ("ms_ssim", "lpips"), ("rmse", "ssim")
"""Metrics side by side, as in the paper."""


@dataclass(frozen=True)
class Table:
    """`groups`: a line above the header, each text over so many columns; `note`: below it."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    groups: Sequence[tuple[str, int]] = ()
    note: str = ""


def number(value: float | None, form: str = ".3f") -> str:
    return MISSING if value is None or not np.isfinite(value) else f"{value:{form}}"


def cell(figure: Figure, form: str, theirs: str) -> str:
    """``ours [the paper's]``; `form` and `theirs`: their formats."""
    return number(figure.ours, form) + ("" if figure.paper is None else f" [{number(figure.paper, theirs)}]")


def seconds(value: float) -> str:
    """Seconds as in the paper, in longer units where they are many."""
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def table2(found: Accuracy, methods: list[str]) -> list[Table]:
    """The paper's four blocks, with the mean over scenes."""
    return _blocks(found, methods, "mean", "", lambda metric: (".3f", ".3f"))


def drops(found: Accuracy, methods: list[str]) -> list[Table]:
    """The same blocks less NRF's column: how much worse each method is than NRF."""
    others = [name for name in methods if name != BASE]
    forms = {"rmse": ("+.1%", "+.1%")}
    return _blocks(found, others, "drop", "drop against NRF, ", lambda m: forms.get(m, ("+.4f", "+.3f")))


def _blocks(found: Accuracy, methods: list[str], what: str, title: str, form) -> list[Table]:
    tables = []
    for kind, light in LIGHTS.items():
        for pair in PAIRS:
            groups = [("", 1), *((METRICS[m], len(methods)) for m in pair), ("", 1)]
            rows = []
            for scene in found.scenes:
                figures = [(m, getattr(found, what)(scene, kind, m, name)) for m in pair for name in methods]
                name = scene.name + (f" [{scene.paper}]" if scene.paper else "")
                counts = {f.images for _, f in figures if f.images}
                images = f"{min(counts)}–{max(counts)}" if len(counts) > 1 else str(*counts or (0,))
                rows.append([name, *(cell(f, *form(m)) for m, f in figures), images])
            means = [(m, found.over_scenes(what, kind, m, name)) for m in pair for name in methods]
            rows.append([f"mean of {len(found.scenes)} [of 3]", *(cell(f, *form(m)) for m, f in means), ""])
            header = ["scene", *methods, *methods, "pictures"]
            tables.append(Table(f"{light}, {title}{METRICS[pair[0]]} and {METRICS[pair[1]]}", header, rows, groups))
    return tables


def table1(costs: times.Costs, sizes: BenchSizes) -> Table:
    """Seconds of the stage and of the whole picture; the paper's settings first, ours below."""
    rows = []
    for (table, culled), title in ((times.MAP, ""), (times.OURS, ", our network, culled on both sides")):
        for kind, light in LIGHTS.items():
            lights, cells = paper.LIGHTS[kind], []
            stages = {"transmittance": times.transmittance(costs, lights, table, culled),
                      "overall": times.overall(costs, sizes, lights, table, culled)}
            for name, (ours, base) in stages.items():
                theirs = (None,) * 3 if culled else paper.TABLE1[kind][name]
                for value, other in zip((ours, base, base / ours), theirs, strict=True):
                    cells.append(seconds(value) + ("" if other is None else f" [{other:.2f}]"))
            rows.append([light + title, *cells])
    return Table("Runtime of TM compared to NRF in seconds", ["", *("TM", "NRF", "times faster") * 2], rows,
                 [("", 1), ("Transmittance", 3), ("Overall", 3)],
                 "600 × 600 pixels, 192 samples a ray, one light and a 50 × 10 environment; networks of the paper's "
                 "size with random weights, composed of measured costs a query and a lookup. The paper's machine is a "
                 "GPU of 2018.")


def complexity(costs: times.Costs) -> Table:
    """The formulas, and what they come to at the paper's sizes."""
    counts = times.queries(paper.LIGHTS["environment"], paper.SIDE**2, paper.SAMPLES, paper.SIDE**2)
    each = times.query_seconds(costs)
    rows = [["formula", *paper.COMPLEXITY.values()],
            ["queries, l = 500, m = c = 600², n = 192", *(f"{counts[k]:.2e}" for k in paper.COMPLEXITY)],
            ["microseconds a query, here", *(f"{1e6 * each[k]:.2f}" for k in paper.COMPLEXITY)],
            ["hours of queries, here", *(f"{counts[k] * each[k] / 3600:.3g}" for k in paper.COMPLEXITY)]]
    measured = {name: np.divide(*times.transmittance(costs, lights, *times.MAP)[::-1])
                for name, lights in paper.LIGHTS.items()}
    note = ("AG asks at every sample of a camera ray, l·n·c; the paper has m for c, which is as large. "
            f"Ideal speed-up of TM over NRF with the queries of reflectance: {paper.ideal_speed_up(1):.2f} × for one "
            f"light, {paper.ideal_speed_up(500):.0f} × for 500; of the transmittance alone {paper.SAMPLES} ×, measured "
            f"{measured['environment']:.0f} × [391 ×].")
    return Table("Time-complexity of relighting with an environment map", ["", *paper.COMPLEXITY], rows, (), note)


def maps(costs: times.Costs, built: dict[str, dict]) -> Table:
    """Seconds a light of map and volume: the paper's scenes' pictures by networks of its size, and our fields."""
    rows = []
    for name, (width, height) in PICTURES.items():
        ours, base = times.transmittance(costs, 1, *times.MAP, width * height)
        theirs = paper.TABLE1["environment"]["transmittance"] if width == height else (None, None, None)
        shown = [f" [{v / 500:.2f}]" if v else "" for v in theirs[:2]] + [f" [{theirs[2]:.0f}]" if theirs[2] else ""]
        values = seconds(ours), seconds(base), f"{base / ours:.0f}"
        rows.append([name, f"{width} × {height}", *(v + s for v, s in zip(values, shown, strict=True))])
    for scene, row in built.items():
        ours, base = (np.polyfit(row["lights"], row[k], 1)[0] for k in ("map", "volume"))
        rows.append([f"{scene}, our field", f"{row['resolution']}²", f"{ours:.3f}", f"{base:.3f}",
                     f"{base / ours:.1f}" if ours > 0 else MISSING])
    return Table("Seconds to make a light's map and volume", ["scene", "texels", "TM", "NRF", "times faster"], rows, (),
                 "The first three: networks of the paper's size, unculled; then the shipped fields, baked into voxels, "
                 "culled on both sides: the slope through the times of several lights.")


PICTURES = {"the paper's synthetic scenes": (600, 600), "the paper's Girl": (592, 478), "the paper's Pony": (763, 544)}


def ablation(rows: dict[tuple[str, str], dict]) -> Table:
    """Relative RMSE against ``raymarch``, by scene and network."""
    names = {"": "shipped network", "ag": "AG", "no_ag": "No AG"}
    scenes = list(dict.fromkeys(scene for scene, _ in rows))
    there = [n for n in names if any((s, n) in rows for s in scenes)]
    body = [[scene, *(number(rows[scene, n]["relative_rmse"]["ray_network"], ".1%") if (scene, n) in rows else MISSING
                      for n in there)] for scene in scenes]
    return Table("Relative RMSE under many directional lights, against a march through the same field",
                 ["scene", *(names[n] for n in there)], body, (),
                 "The paper has pictures alone here; its figures with and without augmentation are in table 2.")


_LATEX = {"\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
          "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "×": r"$\times$", "²": "$^2$", "·": r"$\cdot$",
          "°": r"$^\circ$", "–": "--", "−": "$-$"}


def latex_text(text: str) -> str:
    return "".join(_LATEX.get(c, c) for c in text)


def latex(table: Table) -> str:
    """A ``table`` environment of plain LaTeX (`graphicx` for its width)."""
    columns = "|l|" + "c|" * (len(table.header) - 1)
    lines = []
    if table.groups:
        lines.append(" & ".join(rf"\multicolumn{{{span}}}{{{'|' if k == 0 else ''}c|}}{{{latex_text(text)}}}"
                                for k, (text, span) in enumerate(table.groups)))
    lines += [" & ".join(map(latex_text, row)) for row in [table.header, *table.rows]]
    body = "\n".join(rf"{line} \\ \hline" for line in lines)
    caption = latex_text(". ".join(filter(None, [table.title, table.note])))
    return ("\\begin{table}\n\\centering\n\\resizebox{\\textwidth}{!}{%\n"
            f"\\begin{{tabular}}{{{columns}}} \\hline\n{body}\n\\end{{tabular}}}}\n"
            f"\\caption{{{caption}}}\n\\end{{table}}\n")
