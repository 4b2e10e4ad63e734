"""`mi-ntf inspect`: a data set before training, as a page to look at and as numbers."""

from pathlib import Path

import numpy as np

from mi_ntf.core import files
from mi_ntf.data import assumptions, inspect_figures, measures, orientation
from mi_ntf.data.measures import percent
from mi_ntf.data.page import Page
from mi_ntf.data.readers import FORMS, load_dataset
from mi_ntf.data.schema import Found, Split, View

THUMBNAILS = 12
POINTS = 2000


def inspect(folder: Path, out: Path | None = None, **options) -> dict:
    """Read the data set in `folder` with `options` of :func:`load_dataset`, write the page and return the numbers.

    `out`, the page, is DIR-inspect.html in the current folder unless given. Keys of the result: "folder", "form",
    "said" (what the reader told), "assumed" (the assumptions among that), "warnings", "page", "views" (one mapping a
    photograph) and those of :func:`measures.numbers`. Raises MiNtfError.
    """
    folder = Path(folder)
    out = Path(f"{folder.resolve().name}-inspect.html") if out is None else Path(out)
    files.check(out)
    said: list[str] = []
    splits = load_dataset(folder, said.append, **{k: v for k, v in options.items() if v is not None})
    rows = measures.measure(splits)
    found = measures.numbers(splits, rows)
    form, reader = next((form, reader) for form, is_there, reader in FORMS if is_there(folder))
    found = {"folder": str(folder), "form": form, "said": said, "assumed": assumptions.said(said), **found,
             "warnings": measures.warnings(found, rows), "page": str(out), "views": [_plain(row) for row in rows]}
    _page(folder, reader(folder), splits, rows, found).write(out)
    return found


def print_table(found: dict) -> None:
    """The result of :func:`inspect` for a reader."""
    for text in found["said"]:
        print(text)
    table = summary(found)
    width = max(len(what) for what, _ in table)
    for what, value in table:
        print(f"{what:<{width}}  {value}")
    for text in found["warnings"]:
        print(f"warning: {text}")
    print(found["page"])


def summary(found: dict) -> list[tuple[str, str]]:
    """The numbers of the whole data set as pairs of texts."""
    ratio, balance = found["brightness"]["ratio"], found["white_balance"]
    length = found["distance"]["median"] * found["sphere"]["radius"]
    return [
        ("photographs", ", ".join(f"{count} {which}" for which, count in found["photographs"].items())),
        ("size", f"{found['width']} x {found['height']} pixels"),
        ("object's sphere", f"center {', '.join(f'{v:.4g}' for v in found['sphere']['center'])}; "
                            f"radius {found['sphere']['radius']:.4g}"),
        ("object covers", f"{_range(found['coverage'], 100)} % of a photograph"),
        ("background", "masked" if found["masked"] else f"black; {percent(found['unknown'])} of the pixels unknown"),
        ("cameras to object", f"{_range(found['distance'])} radii; the median is {length:.4g} of the data set's "
                              "lengths"),
        ("pixel at the object", f"{_range(found['pixel'])} radii"),
        ("flash beside the lens", f"{_range(found['flash_degrees'], 1, '.1f')} degrees, seen from the object"),
        ("largest gap of cameras", f"{found['gap']['degrees']:.0f} degrees"),
        ("brightness, largest / smallest", " ".join("–" if r is None else f"{r:.3g}" for r in ratio) + " (R G B)"),
        ("colour, largest / smallest", f"{_number(balance['red_over_green'])} (R/G) "
                                       f"{_number(balance['blue_over_green'])} (B/G)"),
        ("saturated", f"{percent(found['saturated'])} of the object"),
        ("nearly black", f"{percent(found['black'])} of the object"),
        ("silhouette outside the others' hull", f"{_range(found['uncovered'], 100)} %"),
    ]


def _page(folder: Path, read: Found, splits: dict[str, Split], rows: list[measures.Photograph], found: dict) -> Page:
    """The page; `read` is what the reader of the folder's form says."""
    page = Page(f"Data set {folder.resolve().name}")
    page.text(str(folder.resolve()))
    for text in found["warnings"]:
        page.warning(text)
    page.table(["", ""], summary(found))
    if found["said"]:
        page.section("What was found and assumed")
        page.table([""], [[text] for text in found["said"]])
    page.section("Cameras")
    page.figure(inspect_figures.cameras(splits, _some(read.points)), "Cameras and where they look, around the object's "
                "sphere; lengths in its radii.")
    page.figure(inspect_figures.directions(splits, np.array(found["gap"]["direction"])),
                "The sides the object was seen from. Dark: no camera for training is near.")
    settled, _ = orientation.settle(read.views, False)
    views = {view.image: view for split in settled.values() for view in split}
    page.section("Masks")
    page.text("The line is the mask's outline; what is outside is dimmed and bluish"
              + ("." if found["masked"] else ", what is not known is orange.")
              + " The whole object should be inside and nothing else.")
    page.pictures(_thumbnails(folder, views, splits, rows), width=250)
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
                         percent(row.saturated), percent(row.black), f"{row.distance:.3g}", f"{row.flash:.1f}°",
                         percent(row.uncovered)] for i, row in enumerate(rows)], folded=f"All {len(rows)}")
    return page


def _thumbnails(folder: Path, views: dict[Path, View], splits: dict[str, Split], rows: list[measures.Photograph]):
    """(caption, picture) of photographs evenly chosen among `rows`; `views` by their files."""
    white, _ = measures.white_level(splits)
    place = {measures.name(splits, which, i): (which, i) for which, split in splits.items()
             for i in range(len(split.images))}
    for k in np.unique(np.linspace(0, len(rows) - 1, min(THUMBNAILS, len(rows))).round().astype(int)):
        row = rows[k]
        which, i = place[row.name]
        view = views.get(folder / row.name, views.get(Path(row.name)))
        caption = f"{k}: {row.name} ({row.split}), covers {percent(row.coverage)}"
        yield caption, inspect_figures.thumbnail(splits[which], i, view, white)


def _some(points: np.ndarray | None) -> np.ndarray | None:
    """At most ``POINTS`` of the reconstructed points."""
    return None if points is None or not len(points) else points[:: -(-len(points) // POINTS)]


def _plain(row: measures.Photograph) -> dict:
    """A photograph's numbers for JSON: lists for arrays, None for NaN."""
    def plain(value):
        if isinstance(value, np.ndarray):
            return [plain(v) for v in value.tolist()]
        return None if isinstance(value, float) and not np.isfinite(value) else value

    return {key: plain(value) for key, value in row._asdict().items()}


def _range(values: dict | None, scale: float = 1, form: str = ".3g") -> str:
    if values is None:
        return "–"
    least, median, most = (f"{scale * values[key]:{form}}" for key in ("least", "median", "most"))
    return least if least == most else f"{least} to {most} (median {median})"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
