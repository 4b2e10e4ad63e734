"""Page beside a refined field: held-back photographs, and pictures before and after."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..data.page import Page

if TYPE_CHECKING:
    from .comparison import Comparison
    from .refining import Refined


def verdict(report: Refined) -> str:
    """Return a sentence on what the refinement has brought."""
    change = f"held-back photographs differ by {report.after:.1%} and differed by {report.before:.1%}"
    if report.improved:
        return f"the field is closer to the photographs: {change}"
    return f"the field is no closer to the photographs ({change}), so the file holds it as it was"


def print_summary(report: Refined) -> None:
    """Print where the field and its page are, and what the refinement has brought."""
    output = Path(report.file)
    print(f"field: {output}", f"page: {output.with_suffix('.html')} (open it in a browser)", verdict(report),
          f"next: mi-ntf info {shlex.quote(str(output))}", sep="\n")


def write(output: Path, report: Refined, before: Sequence[Comparison], after: Sequence[Comparison],
          trace: Sequence[tuple[int, float]]) -> None:
    """Write the page beside the field file `output`. Differences are relative RMSE."""
    page = Page(output.name)
    (page.text if report.improved else page.warning)(f"{verdict(report)}.".replace("the", "The", 1))
    page.table(["", ""], [["parameters", ", ".join(report.parameters)], ["photographs", report.photographs],
                          ["steps", report.steps], ["minutes", f"{report.seconds / 60:.1f}"],
                          ["difference before", f"{report.before:.2%}"], ["difference after", f"{report.after:.2%}"]])
    page.section("Held-back photographs")
    bright = max(float(np.quantile(c.photograph, 0.99)) for c in before) or 1.0
    for old, new in zip(before, after, strict=True):
        pictures = [(old.name, old.photograph), ("before", old.picture), ("after", new.picture),
                    ("4 × difference before", 4 * np.abs(old.picture - old.photograph)),
                    ("4 × difference after", 4 * np.abs(new.picture - new.photograph))]
        page.pictures([(caption, (0.8 / bright) * picture) for caption, picture in pictures], 200)
    page.section("Refinement")
    if trace:
        numbers, values = zip(*trace, strict=True)
        page.curves("Difference from the photographs, running mean", {"relative RMSE": (numbers, values)}, "step", "")
    if report.gains:
        page.section("Gains")
        page.table(["photograph", "gains"], [[name, " ".join(f"{g:.3f}" for g in row)]
                                             for name, row in report.gains.items()], folded="all photographs")
    page.write(output.with_suffix(".html"))
