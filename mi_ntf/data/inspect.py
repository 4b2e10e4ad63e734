"""`mi-ntf inspect`: a data set before training, as a page and as numbers."""

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf.core import files, progress
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import assumptions, inspect_figures, measures
from mi_ntf.data.measures import Numbers, Splits, percent
from mi_ntf.data.page import Page
from mi_ntf.data.readers import find_form, load_dataset
from mi_ntf.data.schema import DataSet, Split, View

THUMBNAILS = 12
LONGEST = 1024  # pixels of a photograph's longer side up to which training gains detail
POINTS = 2000  # of the reconstructed points, in the figure of the cameras


def inspect(folder: Path, out: Path | None = None, **options: Any) -> Numbers:
    """Read the data set in `folder` with `options` of :func:`load_dataset`, write the page and return the numbers.

    The page `out` is DIR-inspect.html in the current folder by default. Options that are None are ignored. The result
    has "folder", "form", "warnings", "page" and the keys of :func:`measures.numbers`. "said" are sentences of the
    reader, "assumed" the assumptions among them. "estimate" is true if training is to estimate the place of the flash.
    "next" is the command that trains, and "views" has one mapping for each photograph. Raises MiNtfError if the data
    set has a fault, or the page cannot be written.
    """
    folder = Path(folder)
    out = Path(f"{folder.resolve().name}-inspect.html") if out is None else Path(out)
    files.check(out)
    with progress.Stage(f"inspecting {folder}", then=f"{out} is not written"):
        return _inspect(folder, out, options)


def _inspect(folder: Path, out: Path, options: dict[str, Any]) -> Numbers:
    messages: list[str] = []
    splits = load_dataset(folder, messages.append, **{k: v for k, v in options.items() if v is not None})
    rows = measures.measure(splits)
    numbers = measures.numbers(splits, rows)
    estimate = options.get("flash_offset") == "estimate"
    if estimate and numbers["flash_degrees"]:
        raise MiNtfError(f"--flash-offset estimate: {folder} says where its lights are; leave the option out")
    form, _ = find_form(folder)
    data = {"folder": str(folder), "form": form.name, "said": messages,
            "assumed": [text for text in messages if text.startswith(assumptions.PREFIX)],
            "estimate": estimate, **numbers,
            "warnings": measures.warnings(numbers, rows), "page": str(out),
            "next": _next(folder, splits["train"], options),
            "views": [{key: _plain(value) for key, value in row._asdict().items()} for row in rows]}
    with progress.Stage("writing the page", inner=True):
        _page(folder, form.read(folder), splits, rows, data).write(out)
    return data


def print_table(data: Numbers) -> None:
    """Print the result of :func:`inspect` for a reader."""
    table, count = summary(data), len(data["warnings"])
    width = max(len(key) for key, _ in table)
    verdict = f"{count} warning{'s' * (count > 1)}: mend what is named there, or the field will show it"
    print(*data["said"], *(f"{key:<{width}}  {value}" for key, value in table),
          *(f"warning: {text}" for text in data["warnings"]), f"page: {data['page']}",
          f"verdict: {verdict if count else 'nothing here will harm the field'}", f"next: {data['next']}", sep="\n")


def _next(folder: Path, split: Split, options: dict[str, Any]) -> str:
    """Return the command that trains on the data set with the same options; it scales large photographs down."""
    flash, longer = options.get("flash_offset"), max(split.images.shape[1:3])
    if options.get("size") is None and longer > LONGEST:
        options = options | {"size": LONGEST}
    words = ["mi-ntf", "train", str(folder), "-o", f"{folder.resolve().name}.safetensors"]
    for key in ("size", "masks", "background"):
        words += [f"--{key}", str(options[key])] if options.get(key) is not None else []
    if not split.located or flash == "estimate":
        words += ["--flash-offset", "estimate"]
    elif flash is not None:
        words.append(f"--flash-offset={','.join(f'{v:g}' for v in flash)}")
    return shlex.join([*words, "--minutes", "10"])


def summary(data: Numbers) -> list[tuple[str, str]]:
    """Return the numbers of the whole data set as pairs of texts."""
    ratio, balance = data["brightness"]["ratio"], data["white_balance"]
    length = data["distance"]["median"] * data["sphere"]["radius"]
    return [
        ("photographs", ", ".join(f"{count} {split}" for split, count in data["photographs"].items())),
        ("size", f"{data['width']} x {data['height']} pixels"),
        ("object's sphere", f"center {', '.join(f'{v:.4g}' for v in data['sphere']['center'])}; "
                            f"radius {data['sphere']['radius']:.4g}"),
        ("object covers", f"{_range(data['coverage'], 100)} % of a photograph"),
        ("background", "masked" if data["masked"] else f"black; {percent(data['unknown'])} of the pixels unknown"),
        ("cameras to object", f"{_range(data['distance'])} radii; the median is {length:.4g} of the data set's "
                              "lengths"),
        ("pixel at the object", f"{_range(data['pixel'])} radii"),
        ("flash beside the lens", f"{_range(data['flash_degrees'], 1, '.1f')} degrees, seen from the object" if
         data["flash_degrees"] else "not known; training will estimate it, since that takes the object's shape" if
         data.get("estimate") else "not known; taken to be at the lens"),
        ("largest gap of cameras", f"{data['gap']['degrees']:.0f} degrees"),
        ("brightness, largest / smallest", f"{' '.join(map(_number, ratio))} (R G B)"),
        ("colour, largest / smallest", f"{_number(balance['red_over_green'])} (R/G) "
                                       f"{_number(balance['blue_over_green'])} (B/G)"),
        ("saturated", f"{percent(data['saturated'])} of the object"),
        ("nearly black", f"{percent(data['black'])} of the object"),
        ("silhouette outside the others' hull", f"{_range(data['uncovered'], 100)} %"),
    ]


def _page(folder: Path, described: DataSet, splits: Splits, rows: list[measures.Photograph], data: Numbers) -> Page:
    page = Page(f"Data set {folder.resolve().name}")
    page.text(str(folder.resolve()))
    for text in data["warnings"]:
        page.warning(text)
    page.table(["", ""], summary(data))
    if data["said"]:
        page.section("Findings and assumptions")
        page.table([""], [[text] for text in data["said"]])
    page.section("Cameras")
    points = described.points
    points = None if points is None or not len(points) else points[:: -(-len(points) // POINTS)]
    page.figure(inspect_figures.cameras(splits, points), "Cameras and their view directions around the object's "
                "sphere; lengths in its radii.")
    page.figure(inspect_figures.directions(splits, np.array(data["gap"]["direction"])),
                "Directions from the object. Dark: no camera for training is near.")
    turned, _ = assumptions.turn(described.views, False)
    page.section("Masks")
    page.text("The line is the mask's outline. Pixels outside it are dimmed and bluish"
              + ("." if data["masked"] else ", unknown pixels are orange.")
              + " The whole object should be inside, and nothing else.")
    page.pictures(_thumbnails(folder, {view.image: view for view in assumptions.every(turned)}, splits, rows), 250)
    page.section("Brightness")
    page.text("Mean of the object's pixels as apparent albedo, π L d²/I. Slow changes are the object's sides; jumps "
              "are the camera's or the flash's.")
    number = range(len(rows))
    page.curves("Brightness of the object by photograph", {
        colour: (number, [row.brightness[k] for row in rows]) for k, colour in enumerate(("red", "green", "blue"))},
        xlabel="photograph", ylabel="apparent albedo", log=any((row.brightness > 0).any() for row in rows))
    page.section("Photographs")
    header = ["", "file", "split", "covers", "R", "G", "B", "saturated", "black", "distance", "flash", "outside hull"]
    page.table(header, [[i, row.name, row.split, percent(row.coverage), *(f"{v:.3g}" for v in row.brightness),
                         percent(row.saturated), percent(row.black), f"{row.distance:.3g}",
                         f"{row.flash:.1f}°" if np.isfinite(row.flash) else "–",
                         percent(row.uncovered)] for i, row in enumerate(rows)], folded=f"All {len(rows)}")
    return page


def _thumbnails(folder: Path, views: dict[Path, View], splits: Splits, rows: list[measures.Photograph]
                ) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (caption, picture) of photographs evenly chosen among `rows`; `views` are keyed by their files."""
    white, places = measures.white_level(splits).level, measures.places(splits)
    for k in np.unique(np.linspace(0, len(rows) - 1, min(THUMBNAILS, len(rows))).round().astype(int)):
        name, split, i = places[k]
        view = views.get(folder / name, views.get(Path(name)))
        yield (f"{k}: {name} ({split}), covers {percent(rows[k].coverage)}".replace(" %", "\u00a0%"),
               inspect_figures.thumbnail(splits[split], i, view, white))


def _plain(value: object) -> object:
    """Return `value` for JSON: lists for arrays, None for NaN."""
    if isinstance(value, np.ndarray):
        return [_plain(v) for v in value.tolist()]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _range(values: dict[str, float] | None, scale: float = 1, form: str = ".3g") -> str:
    if values is None:
        return "–"
    least, median, most = (f"{scale * values[key]:{form}}" for key in ("least", "median", "most"))
    return least if least == most else f"{least} to {most} (median {median})"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
