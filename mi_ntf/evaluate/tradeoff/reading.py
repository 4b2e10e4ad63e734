"""Reads the rows of a study: which points are the front, and what a reader should take from the curve, in sentences."""

from typing import Any

import numpy as np

from . import errors
from .points import STOCK
from .search import WORST, front

THRESHOLDS = (0.1, 0.05, 0.02, 0.01)
"""Errors that readers ask for."""


def total(row: dict[str, Any]) -> float:
    """Seconds of a picture whose kernels are compiled and whose maps are not made yet."""
    return row["build"] + row["render"]


def measured(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with figures."""
    return [row for row in rows if not row["reason"]]


def mark_front(rows: list[dict[str, Any]]) -> None:
    """Say of each row whether it is on the Pareto front of seconds and error (``front``), number the rows (``number``,
    by seconds, those without figures last), and sort them so."""
    good = measured(rows)
    ends = set(front((total(row), row["error"]) for row in good))
    for row in rows:
        row["front"] = not row["reason"] and (total(row), row["error"]) in ends
    rows.sort(key=lambda row: (bool(row["reason"]), 0.0 if row["reason"] else total(row), row["label"]))
    for number, row in enumerate(rows, 1):
        row["number"] = number


def knee(ends: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The row of a front, sorted by seconds, that lies farthest below the straight line between its ends, on log axes;
    None for fewer than three that are of any use."""
    ends = [row for row in ends if row["error"] < WORST]
    if len(ends) < 3:
        return None
    x, y = (np.log([max(v, 1e-9) for v in values]) for values in (
        [total(row) for row in ends], [row["error"] for row in ends]))
    if x[-1] <= x[0]:
        return None
    depth = y[0] + (y[-1] - y[0]) * (x - x[0]) / (x[-1] - x[0]) - y
    return ends[int(depth.argmax())] if depth.max() > 0.05 else None


def reading(rows: list[dict[str, Any]]) -> list[str]:
    """Sentences, of rows that :func:`mark_front` has seen."""
    ends = [row for row in rows if row["front"]]
    if not ends:
        return ["No point was measured."]
    found = [_fastest(ends)]
    if (bend := knee(ends)) is not None:
        found.append(f"The curve bends at no. {bend['number']}, {_told(bend)}: what is faster loses much accuracy, "
                     "what is more accurate takes much longer.")
    found += _stock(rows)
    biased = [row for row in ends if row["bias"] > row["noise"] and error(row).known]
    if biased:
        which = f"no. {', '.join(str(row['number']) for row in biased)}" if len(biased) < 6 else f"{len(biased)} points"
        found.append(f"On the front, {which} err by bias more than by noise: more samples do not help there.")
    else:
        found.append("All of the front errs by noise more than by bias: more samples a pixel still help.")
    return found


def _fastest(ends: list[dict[str, Any]]) -> str:
    """What is fastest below each of the errors that readers ask for."""
    reached = []
    for limit in THRESHOLDS:
        below = next((row for row in ends if row["error"] < limit), None)
        if below is not None:
            reached.append(f"below {limit:.0%} no. {below['number']}, {_told(below)}")
    least = ends[-1]
    if not reached:
        return f"Nothing comes below {THRESHOLDS[0]:.0%}; the least error is that of {_told(least)}."
    missed = [limit for limit in THRESHOLDS if least["error"] >= limit]
    tail = f" Nothing comes below {missed[0]:.0%}; the least is {least['error']:.1%}." if missed else ""
    return "Fastest with an error " + "; ".join(reached) + "." + tail


def _stock(rows: list[dict[str, Any]]) -> list[str]:
    """How much sooner the front has the error of stock `volpath`."""
    for row in reversed(measured(rows)):
        if row["point"]["method"] != STOCK:
            continue
        better = next((r for r in rows if r["front"] and r["error"] <= row["error"]), None)
        if better is not None and better is not row and 1.5 * total(better) < total(row):
            return [f"Stock volpath errs by {row['error']:.0%} after {total(row):.3g} s; {better['label']} errs no "
                    f"more after {total(better):.3g} s, {total(row) / total(better):.0f} times sooner."]
        return []
    return []


def _told(row: dict[str, Any]) -> str:
    return f"{row['label']} ({total(row):.3g} s, {row['error']:.1%})"


def groups(rows: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Measured rows of equal settings, by samples a pixel."""
    found: dict[tuple, list[dict[str, Any]]] = {}
    for row in measured(rows):
        found.setdefault(tuple(v for k, v in row["point"].items() if k != "spp"), []).append(row)
    return [sorted(group, key=lambda row: row["point"]["spp"]) for group in found.values()]


def error(row: dict[str, Any]) -> errors.Error:
    """The error of a measured row."""
    return errors.Error(row["noise"], row["bias"], row["uncertainty"])


def busy(rows: list[dict[str, Any]], cores: int) -> str:
    """A warning where other work ran on the machine; "" where it did not."""
    most = max((row["load"] for row in measured(rows)), default=0.0)
    if most <= cores + 1:
        return ""
    return (f"Other work ran beside the study: up to {most:.0f} jobs on {cores} cores. Seconds are too high and "
            "uneven, errors are as they are.")
