"""Tables of the pages, generated from ``benchmarks/results/*.json``.

    python -m benchmarks.tables           # write them into README.md and docs/**/*.md
    python -m benchmarks.tables --check   # exit code 1, and the names, where a page differs from its JSON
    python -m benchmarks.tables --list    # names of all tables, and the script that measures each

A page marks the place of a table by two lines. The lines between them are replaced:

    <!-- table: demo -->
    <!-- end -->

A number within a line of text is marked by the name of the file and the keys of the value, joined by dots. A format
of Python or of `FORMATS` follows:

    The lookup takes <!-- value: speed.lookup.median .1f -->7.8<!-- end --> ns.

In place of a table whose JSON file does not exist, the page says that it is not measured. Such a value stays as it is.
"""

import re
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from . import paper, record
from .record import ROOT

PAGES = ("README.md", "docs/**/*.md")
TABLE = re.compile(r"(<!-- table: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.S)
VALUE = re.compile(r"(<!-- value: (\S+) (\S+) -->)(.*?)(<!-- end -->)")
FORMATS: dict[str, Callable[[float], str]] = {"percent": lambda v: f"{100 * v:.1f} %", "s": lambda v: _seconds(v)}
LIGHTS = {"point": "point light", "env": "environment map"}
METHODS = ("raymarch", "transmittance_atlas", "neural_transmittance")
MISSING = "Not measured for this version: `python -m benchmarks.{}` does it."
Values = dict[str, Any]


def table(header: Iterable[str], rows: Iterable[Iterable[str]], text_columns: int = 1) -> str:
    """Return a Markdown table; columns after the first `text_columns` are aligned to the right."""
    cells = list(header)
    rule = "".join("---|" if i < text_columns else "---:|" for i in range(len(cells)))
    title, *lines = (f"| {' | '.join(line)} |" for line in (cells, *rows))
    return "\n".join([title, f"|{rule}", *lines])


def number(value: float) -> str:
    """Return three digits of a number, without an exponent."""
    return f"{value:,.0f}".replace(",", " ") if abs(value) >= 100 else f"{value:.3g}"


def spread(entry: Values, unit: str = "", form: Callable[[float], str] = number, scale: float = 1.0) -> str:
    """Return the median of repeated measurements, and the least and largest in brackets."""
    middle, low, high = (form(scale * entry[key]) for key in ("median", "min", "max"))
    between = f" ({low} to {high})" if entry["repeats"] > 1 and low != high else ""
    return f"{middle}{' ' + unit if unit else ''}{between}"


def percent(value: float, form: str = ".1f") -> str:
    """Return a fraction in percent."""
    return f"{100 * value:{form}} %"


def _seconds(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:,.0f}".replace(",", " ")


def source(name: str) -> str:
    """Return a line that says when and where a file of results was measured."""
    head = record.read(name)["about"]
    processor = re.sub(r"\s+", " ", re.sub(r"\((R|TM)\)|CPU|Processor|@.*", "", head["machine"]["processor"])).strip()
    return (f"`benchmarks/results/{name}.json`: commit {head['commit']}, {head['date'][:10]}, {processor}, "
            f"{head['machine']['cores']} cores")


def demo_rows(rows: list[Values], full: bool) -> str:
    """Return the table of the demo's renders; `full`: with all metrics."""
    header = ["light", "visibility", "seconds", *(["SSIM"] if full else []), "PSNR, dB",
              *(["HDR-FLIP"] if full else []), "relative RMSE" if full else "RMSE",
              "rel. RMSE to `raymarch`" if full else "to `raymarch`"]
    lines = []
    for m in rows:
        seconds = spread(m["seconds"], form=_seconds) if full else f"{m['seconds']['median']:.1f}"
        lines.append([LIGHTS[m["light"]], f"`{m['visibility']}`", seconds, *([f"{m['ssim']:.3f}"] if full else []),
                      f"{m['psnr']:.1f}", *([f"{m['flip']:.3f}"] if full else []), percent(m["relative_rmse"]),
                      percent(m["relative_rmse_to_raymarch"])])
    return table(header, lines, 2)


def speed(values: Values) -> str:
    """Return the rows of the README."""
    def times(key: str) -> str:
        return f"{number(values[key]['median'])} ×"

    rows = [
        ["transmittance of 500 lights, networks of the paper's size: volume over map, unculled (391 ×)",
         times("stage_unculled")],
        ["the same, whole picture: unculled (92 ×); culled on both sides",
         f"{times('whole_unculled_600')}; {times('whole_culled_600')}"],
        ["whole picture, shipped field, `transmittance_map` (522 s on a GPU)",
         f"{_seconds(values['picture_500']['median'])} s"]]
    return table(["what", "measured"], rows)


def speed_paper(values: Values) -> str:
    """Return how much faster maps are than volumes, by networks of the paper's size and by ours."""
    columns = {"unculled": "unculled", "culled": "culled", "own_unculled": "our network, volume unculled",
               "own_culled": "our network, culled"}
    rows = {"stage_{}": "transmittance of 500 lights, 600² rays each (391 ×)",
            "whole_{}_600": "whole picture of 600² pixels, maps of 600² texels (92 ×)",
            "whole_{}_128": "whole picture of 600² pixels, maps of 128² texels"}
    return table(["volume over map", *columns.values()],
                 [[title, *(spread(values[key.format(column)], "×") for column in columns)]
                  for key, title in rows.items()])


def speed_methods(values: Values) -> str:
    """Return the seconds and the error of one picture by each method."""
    names = [key.removeprefix("method_error_") for key in values if key.startswith("method_error_")]
    title = values[f"method_{names[0]}"]["title"].rpartition(",")[0]

    def over(other: str, name: str) -> str:
        ratio = values.get(f"method_{other}_over_{name}")
        return spread(ratio, "×") if ratio else ""

    return table([title, "seconds", "speed-up over `raymarch`", "over `transmittance_volume`", "relative RMSE"], [
        [f"`{name}`", spread(values[f"method_{name}"], form=_seconds), over("raymarch", name),
         over("transmittance_volume", name), f"{values[f'method_error_{name}']['median']:.1f} %"] for name in names])


def speed_fields(values: Values) -> str:
    """Return nanoseconds per point and light, by method and by the representation of the field."""
    columns = {"voxels": "voxels", "shipped": "shipped networks", "paper": "networks of the paper's size"}
    names = [key.removeprefix("setting_voxels_") for key in values if key.startswith("setting_voxels_")]
    return table(["ns per point and light", *columns.values()], [
        [f"`{name}`", *(spread(values[key]) if (key := f"setting_{column}_{name}") in values else ""
                        for column in columns)] for name in names])


def speed_full(values: Values) -> str:
    """Return all figures that the other tables of speed do not show."""
    others = ("stage", "whole", "method", "setting")
    return table(["what", "measured"], [[f["title"].replace("_", "\\_"), spread(f, f["unit"])]
                                        for key, f in values.items() if "median" in f and not key.startswith(others)])


KINDS = {"random": "random directions", "same": "the same lights", "env": "environment", "area": "area light"}
"""Titles of what `benchmarks.loops` compares."""


def _loops(case: str) -> Callable[[Values], str]:
    """Return a function that makes the table of a case of `benchmarks.loops`."""
    kinds = case in ("loop", "sampled")
    more = {"whole": ["relative RMSE"], "sampled": ["time to equal noise"]}.get(case, [])
    header = ["scene", *(["towards" if case == "loop" else "light"] if kinds else []), "method",
              "ns" if case == "loop" else "seconds", "speed-up", *more]

    def rows(values: Values) -> str:
        lines = []
        for scene, row in values[case].items():
            for kind, part in row.items() if kinds else [("", row)]:
                lines += [[scene, *([KINDS[kind]] if kinds else []), f"`{m}`", *cells(part, m)]
                          for m in part if m in METHODS]
        return table(header, lines, len(header) - 2 - len(more))

    def cells(part: Values, method: str) -> list[str]:
        row = part[method]
        if case == "loop":
            return [spread(row), "" if method == METHODS[0] else spread(part["ratio"], "×")]
        last = {"whole": lambda: [percent(row["error"])], "sampled": lambda: [number(row["equal_noise"])]}
        ratio = "" if method == METHODS[0] else spread(row["ratio"], "×")
        return [spread(row["seconds"], form=_seconds), ratio, *last.get(case, list)()]

    return rows


def _dial(case: str) -> Callable[[Values], str]:
    """Return a function that makes the table of a case of `benchmarks.dial`."""
    columns: dict[str, dict[str, Callable[[Values], str]]] = {
        "error": {"pictures": lambda r: str(r["frames"]), "error": lambda r: percent(r["error"]),
                  "seconds": lambda r: _seconds(r["seconds"]), "best fixed choice, s": lambda r:
                  _seconds(r["best_seconds"]), "ratio": lambda r: f"{r['ratio']:.2f}",
                  "`raymarch`, s": lambda r: _seconds(r["march_seconds"])},
        "noise": {"`noise_threshold`": lambda r: f"{r['threshold']:g}", "noise": lambda r: f"{r['noise']:.3f}",
                  "reported": lambda r: f"{r['reported']:.3f}", "samples": lambda r: str(r["spp"]),
                  "seconds": lambda r: _seconds(r["seconds"])},
        "time": {"`time_budget`, s": lambda r: f"{r['budget']:g}", "seconds": lambda r: _seconds(r["seconds"]),
                 "error": lambda r: percent(r["error"]), "best fixed choice": lambda r: f"`{r['best']}`",
                 "its error": lambda r: percent(r["best_error"])},
        "effects": {"error": lambda r: percent(r["error"]), "seconds": lambda r: _seconds(r["seconds"]),
                    "nothing left out, s": lambda r: _seconds(r["whole_seconds"]),
                    "ratio": lambda r: f"{r['ratio']:.2f}"},
        "stock": {"seconds": lambda r: _seconds(r["seconds"]), "samples": lambda r: str(r["spp"]),
                  "`volpath`, s": lambda r: _seconds(r["computed_seconds"]), "ratio": lambda r: number(r["ratio"])},
    }
    return lambda values: table(["scene", "light", *columns[case]], [
        [row["scene"], row["light"], *(cell(row) for cell in columns[case].values())] for row in values[case]], 2)


def brightness(values: Values) -> str:
    """Return the brightness of fields beside their meshes."""
    return table(["scene", "light", "brightness", "relative RMSE", "aligned"],
                 [[scene, light, percent(row["brightness"], "+.1f"), percent(row["relative_rmse"]),
                   percent(row["aligned"])] for scene, rows in values["brightness"].items()
                  for light, row in rows.items()], 2)


def photographs(values: Values) -> str:
    """Return the agreement of fields with photographs of their meshes."""
    return table(["scene", "PSNR, dB", "SSIM", "normals, degrees"],
                 [[scene, spread(row["psnr"], form="{:.1f}".format), spread(row["ssim"], form="{:.3f}".format),
                   f"{row['normal_error']:.1f}"] for scene, row in values["photographs"].items()])


def transmittance(values: Values) -> str:
    """Return the errors of the learned transmittance."""
    names = [name for name in next(iter(values["transmittance"].values())) if name != "query_ns"]
    return table(["scene", *names, "ns a query"], [[scene, *(percent(row[name]) for name in names),
                                                    spread(row["query_ns"])]
                                                   for scene, row in values["transmittance"].items()])


def sequence(values: Values) -> str:
    """Return the cost of frames."""
    memory = values["memory"]
    rows = [["first frame, s", _seconds(values["first"])],
            ["later frames, s", spread(values["each"], form=_seconds)],
            ["last 30 frames, s", spread(values["late"], form=_seconds)],
            ["call of the stock program, s", spread(values["stock"], form=_seconds)],
            [f"{values['frames']} calls over {values['frames']} frames", f"{values['ratio']:.1f} ×"],
            ["memory after the second and the last frame, MiB", f"{memory[0]:.0f}, {memory[1]:.0f}"]]
    return table(["what", "measured"], rows)


def _choice(options: Values) -> str:
    """Return the properties of an integrator as text."""
    return ", ".join(f"`{v}`" if k == "visibility" else f"`{k}` {v}" for k, v in options.items())


def smoke(values: Values) -> str:
    """Return the seconds of stock smoke to 2 % of error beside `volpath`."""
    return table(["light", "choice", "samples", "error", "seconds", "`volpath`, s", "ratio"], [
        [row["light"], _choice(row["options"]), str(row["spp"]), percent(row["error"]),
         spread(row["seconds"], form=_seconds), spread(row["volpath_seconds"], form=_seconds),
         spread(row["ratio"], "×") if row["reached"] else "2 % not reached"] for row in values["rows"]], 2)


def media(values: Values) -> str:
    """Return the agreement with `volpath` in Mitsuba's own scenes of media."""
    return table(["scene", "depth", "choice", "mean over `volpath`", "standard error", "largest block", "z-test"], [
        [row["scene"].removeprefix("test_"), "", "refused by a sentence", "", "", "", ""] if "refused" in row else
        [row["scene"].removeprefix("test_"), str(row["depth"]), _choice(row["options"]) or "`auto`",
         f"{row['ratio']:.4f}", percent(row["standard_error"], ".2f"), percent(row["worst_block"]),
         "passes" if row["passes"] else "fails"] for row in values["rows"]], 3)


def splats(values: Values) -> str:
    """Return the figures of Gaussian splats that were imported as voxels."""
    header = ["splats", "import, s", "import, GiB", "field, MB", "random rays, RMS error", "grazing rays, RMS error",
              "shadow, rel. RMSE", "tracing over atlas, seconds"]
    rows = [[f"{int(count):,}".replace(",", " "), f"{row['import']['seconds']:.1f}",
             f"{row['import']['gibibytes']:.2f}", f"{row['import']['megabytes']:.0f}",
             f"{row['transmittance']['random']:.1e}",
             f"{row['transmittance']['grazing']:.1e}", percent(row["shadow"]),
             f"{row['lookup']['ratio']['median']:.0f} ×"]
            for count, row in values.items()]
    return table(header, rows)


def objects(values: Values) -> str:
    """Return the errors of relit objects to their meshes, by object and light."""
    header = ["object", "light", "relative RMSE", "aligned", "PSNR, dB", "SSIM", "mean, by channel"]
    rows = [[", ".join(row["object"].rsplit("-", 1)), row["light"], percent(row["relative_rmse"]),
             percent(row["aligned"]), f"{row['psnr']:.1f}", f"{row['ssim']:.3f}",
             ", ".join(f"{100 * (c - 1):+.1f}" for c in row["mean"]) + " %"] for row in values["rows"]]
    return table(header, rows, 2)


def _reproduce(name: str) -> Callable[[Values], str]:
    return lambda values: str(getattr(paper, name)(values))


TABLES: dict[str, tuple[str, Callable[[Values], str]]] = {
    "demo": ("demo", lambda values: demo_rows(values["rows"], full=False)),
    "demo-full": ("demo", lambda values: demo_rows(values["rows"], full=True)),
    "speed": ("speed", speed),
    "speed-paper": ("speed", speed_paper),
    "speed-full": ("speed", speed_full),
    "speed-methods": ("speed", speed_methods),
    "speed-fields": ("speed", speed_fields),
    **{f"loops-{case}": ("loops", _loops(case)) for case in ("loop", "whole", "sampled", "floor", "bounces")},
    **{f"dial-{case}": ("dial", _dial(case)) for case in ("error", "noise", "time", "effects", "stock")},
    "brightness": ("fields", brightness),
    "photographs": ("fields", photographs),
    "transmittance": ("fields", transmittance),
    "sequence": ("sequence", sequence),
    "smoke": ("smoke", smoke),
    "media": ("media", media),
    "splats": ("splats", splats),
    "objects": ("objects", objects),
    "paper-times": ("speed", _reproduce("times_table")),
    "paper-complexity": ("speed", _reproduce("complexity_table")),
    "paper-accuracy": ("reproduce", _reproduce("accuracy_table")),
    "paper-drops": ("reproduce", _reproduce("drops_table")),
    "paper-build": ("reproduce", _reproduce("build_table")),
    "paper-ablation": ("reproduce", _reproduce("ablation_table")),
}
"""Name of a table → file of results, and the function that makes Markdown of its values."""


def rendered(text: str, note: Callable[[str], None] = lambda text: None) -> str:
    """Return a page with its tables and values; `note` is called for each whose results do not exist.

    Raises KeyError for names that do not exist.
    """
    def replace_table(match: re.Match[str]) -> str:
        name, make = TABLES[match[2]]
        if not (record.RESULTS / f"{name}.json").is_file():
            note(f"table {match[2]}: no {name}.json; run `python -m benchmarks.{name}`")
            return f"{match[1]}{MISSING.format(name)}\n{match[4]}"
        return f"{match[1]}{make(record.read(name)['values'])}\n\n{source(name)}.\n{match[4]}"

    def replace_value(match: re.Match[str]) -> str:
        name, *keys = match[2].split(".")
        if not (record.RESULTS / f"{name}.json").is_file():
            note(f"value {match[2]}: no {name}.json; run `python -m benchmarks.{name}`")
            return match[0]
        value: Any = record.read(name)["values"]
        for key in keys:
            value = value[int(key)] if isinstance(value, list) else value[key]
        shown = FORMATS[match[3]](value) if match[3] in FORMATS else format(value, match[3])
        return f"{match[1]}{shown}{match[5]}"

    return VALUE.sub(replace_value, TABLE.sub(replace_table, text))


def pages() -> list[Path]:
    """Return the pages that may hold tables."""
    return sorted(path for pattern in PAGES for path in ROOT.glob(pattern))


def different(write: bool = False) -> list[str]:
    """Return the names of the pages that differ from their results, and bring them up to date if `write`."""
    names = []
    for path in pages():
        text = path.read_text(encoding="utf-8")
        new = rendered(text, partial(print, f"{path.name}:", file=sys.stderr))
        if new != text:
            names.append(str(path.relative_to(ROOT)))
            if write:
                path.write_text(new, encoding="utf-8")
    return names


def main() -> int:
    """Run the command line and return the exit code."""
    words = sys.argv[1:]
    if words == ["--list"]:
        for name, (script, _) in TABLES.items():
            print(f"{name:<20} python -m benchmarks.{script}")
        return 0
    if words not in ([], ["--check"]):
        print(__doc__)
        return 2
    names = different(write=not words)
    for name in names:
        print(f"{name}: {'differs from its results' if words else 'brought up to date'}")
    return 1 if names and words else 0


if __name__ == "__main__":
    sys.exit(main())
