"""Means over pictures and scenes, and drops against NRF, of finished jobs."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from . import paper
from .compared import METRICS, Scene

BASE = "NRF"
HIGHER_IS_BETTER = {"ms_ssim", "ssim"}


@dataclass(frozen=True)
class Figure:
    """A number of ours, of so many pictures, and the paper's; None: not measured, or not in the paper."""

    ours: float | None = None
    images: int = 0
    paper: float | None = None


def drop(metric: str, value: float, base: float) -> float:
    """How much worse `value` is than that of NRF: SSIM and MS-SSIM lost, LPIPS gained, rMSE gained as a share of NRF's.
    Below 0: better."""
    if metric == "rmse":
        return value / base - 1 if base else float("nan")
    return base - value if metric in HIGHER_IS_BETTER else value - base


class Accuracy:
    """Measures of pictures: `rows` of finished jobs of :mod:`.images`; `shared`: how many were made beside others."""

    def __init__(self, rows: Iterable[dict], scenes: list[Scene]):
        self.scenes = scenes
        self._found: dict[tuple, dict[str, dict]] = {}
        self.seconds: dict[tuple[str, str], list[float]] = {}
        self.shared = 0
        for row in rows:
            self._found.setdefault((row["scene"], row["kind"], row["method"]), {})[row["light"]] = row["metrics"]
            self.seconds.setdefault((row["kind"], row["method"]), []).append(row["seconds"])
            self.shared += "shared" in row

    def methods(self, known: Iterable[str]) -> list[str]:
        """Those of `known` with a picture."""
        there = {method for _, _, method in self._found}
        return [name for name in known if name in there]

    def mean(self, scene: Scene, kind: str, metric: str, method: str) -> Figure:
        """The mean over all finished pictures."""
        found = self._values(scene.name, kind, method, metric)
        theirs = paper.mean(scene.paper, kind, metric, method)
        return Figure(float(np.mean(list(found.values()))) if found else None, len(found), theirs)

    def drop(self, scene: Scene, kind: str, metric: str, method: str) -> Figure:
        """:func:`drop` of the means over the pictures that are finished for both."""
        found, base = (self._values(scene.name, kind, name, metric) for name in (method, BASE))
        common = sorted(found.keys() & base.keys())
        theirs, zero = (paper.mean(scene.paper, kind, metric, name) for name in (method, BASE))
        their_drop = None if theirs is None or zero is None else drop(metric, theirs, zero)
        if not common:
            return Figure(None, 0, their_drop)
        ours = drop(metric, *(float(np.mean([f[light] for light in common])) for f in (found, base)))
        return Figure(ours, len(common), their_drop)

    def over_scenes(self, what: str, kind: str, metric: str, method: str) -> Figure:
        """The mean over scenes of `what`, ``mean`` or ``drop``. The paper's is over all of its own scenes."""
        each = [getattr(self, what)(scene, kind, metric, method) for scene in self.scenes]
        ours = [f.ours for f in each if f.ours is not None]
        return Figure(float(np.mean(ours)) if ours else None, sum(f.images for f in each),
                      _paper_over_scenes(what, kind, metric, method))

    def _values(self, scene: str, kind: str, method: str, metric: str) -> dict[str, float]:
        rows = self._found.get((scene, kind, method), {})
        return {light: row[metric] for light, row in rows.items() if row.get(metric) is not None}

    def measured(self, metric: str) -> bool:
        """Whether any picture has it."""
        return any(row.get(metric) is not None for rows in self._found.values() for row in rows.values())

    def images(self) -> tuple[int, int]:
        """Fewest and most pictures of a mean."""
        counts = [len(rows) for rows in self._found.values()]
        return (min(counts), max(counts)) if counts else (0, 0)

    def summary(self, methods: list[str]) -> dict:
        """Drops over scenes by kind of light, method and metric, for JSON."""
        kinds = sorted({kind for _, kind, _ in self._found}, reverse=True)
        found: dict = {}
        for kind in kinds:
            for method in methods:
                if method != BASE:
                    each = {m: self.over_scenes("drop", kind, m, method) for m in METRICS}
                    found.setdefault(kind, {})[method] = {m: {"ours": f.ours, "paper": f.paper, "images": f.images}
                                                          for m, f in each.items()}
        return found


def _paper_over_scenes(what: str, kind: str, metric: str, method: str) -> float | None:
    if method not in paper.METHODS:
        return None
    scenes = [name for name, light in paper.TABLE2 if light == kind]
    values = [paper.mean(name, kind, metric, method) for name in scenes]
    bases = [paper.mean(name, kind, metric, BASE) for name in scenes]
    if what == "mean":
        return float(np.mean(values))  # type: ignore[arg-type]  # none of them is None
    return float(np.mean([drop(metric, v, b) for v, b in zip(values, bases, strict=True) if v and b]))
