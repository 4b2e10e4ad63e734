"""``mi-ntf tradeoff``: the study of one scene, from its references to its report."""

import re
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ... import __version__
from ...core import files
from ...core.errors import MiNtfError, sentence
from ...infer.visibility import REGISTRY
from ...jobs import Workers
from ...render.cost import model
from . import errors, reading, references, report
from .measure import measure
from .points import STOCK, Point, from_dict, label
from .references import Reference
from .search import Proposal, Result, Search
from .state import ATTEMPTS, State, name_of
from .subject import Picture, Subject

print_table = report.print_table

REFERENCE, CHECK, MESH = 0.35, 0.12, 0.05
"""Shares of the budget: the converged reference, its comparison with stock `volpath`, a mesh scene to be rendered."""
UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
LEAST_BUDGET = 1.0
PATIENCE, LEAST_PATIENCE = 4.0, 0.15
"""A rendering is stopped that takes so many times what was predicted, and more than this share of the budget."""

Tell = Callable[[float, str, bool], None]
"""Hears the seconds spent so far, what is done now, and whether it is done."""


def seconds(text: str) -> float:
    """The seconds of `text`: 90s, 5m, 1h. Raises MiNtfError."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([smh])", text.strip())
    found = float(match[1]) * UNITS[match[2]] if match else 0.0
    if found < LEAST_BUDGET:
        raise MiNtfError(f"--budget is '{text}', expected a time of a second or more such as 90s, 5m or 1h")
    return found


class Study:
    """One run of the study. `tell` hears what is done; `workers` render the passes of the reference. Points are
    measured here, one after the other: beside others their seconds would be no measure."""

    def __init__(self, subject: Subject, out: Path, budget: float, reference: Path | None, tell: Tell,
                 workers: Workers = Workers()):  # noqa: B008
        self._workers = workers
        self.subject, self.budget, self._tell = subject, budget, tell
        self.state = State(out, _key(subject, reference))
        self._mesh_path = reference or references.find_mesh(subject)
        self._must_have_mesh = reference is not None
        self._mark, self._before = time.perf_counter(), sum(f.get("spent", 0.0) for f in self.state.findings)
        if self.state.fresh:
            self.tell(f"begun anew, what lay in {out} is of another {self.state.fresh}", True)
        elif self.points:
            self.tell(f"goes on, {len(self.points)} points are there", True)
        self.reference: Reference | None = None
        self.mesh: Reference | None = None

    @property
    def spent(self) -> float:
        """Seconds of the budget that are gone, those of earlier runs included."""
        return self._before + time.perf_counter() - self._mark

    @property
    def points(self) -> list[dict[str, Any]]:
        """Rows that were measured or failed."""
        return self.state.of("point")

    def tell(self, text: str, done: bool = False) -> None:
        """Say what is done now, or was done."""
        self._tell(self.spent, text, done)

    def run(self) -> None:
        """Everything, as far as it is not there."""
        self._prepare()
        search = self._search()
        while (proposal := search.next(self.budget - self.spent)) is not None:
            self.tell(f"{label(proposal.point, self.subject.base)}: about {proposal.seconds:.2g} s")
            self._try(proposal)
            self._inform(search)
        self._add("end", skipped=[_skipped(p, self.subject) for p in search.left_out()])

    def _add(self, kind: str, **values: Any) -> dict[str, Any]:
        """A finding, with the seconds since the one before it."""
        now, gone = time.perf_counter(), self.spent
        self._before, self._mark = gone, now
        before = sum(f.get("spent", 0.0) for f in self.state.findings)
        return self.state.add(kind, **values, spent=gone - before)

    def _prepare(self) -> None:
        """The size of the picture and the references."""
        share = REFERENCE * self.budget
        if not (found := self.state.one("picture")):
            self.tell("how large a picture the budget allows")
            picture, about = references.choose_picture(self.subject, 0.8 * share)
            found = self._add("picture", shrink=picture.shrink, about=about)
            self.tell(about, True)
        self.picture = Picture(found["shrink"])
        self.reference = self._kept("reference", lambda: references.converge(
            self.subject, self.picture, max(share - self.spent, 0.0), self.tell, self._workers, self.state.folder))
        if not self.state.one("check"):
            self.tell("the reference against stock volpath")
            check = self._add("check", **references.hold_against_stock(
                self.subject, self.picture, self.reference.image, CHECK * self.budget, self.tell))
            self.tell(check["verdict"], True)
        if self._mesh_path:
            try:
                self.mesh = self._kept("mesh", self._find_mesh)
            except MiNtfError as error:
                if self._must_have_mesh:
                    raise
                self.tell(f"no mesh reference: {error}", True)

    def _find_mesh(self) -> Reference:
        assert self._mesh_path is not None and self.reference is not None
        return references.mesh(self.subject, self._mesh_path, self.picture, self.reference.image.shape,
                               MESH * self.budget)

    def _kept(self, kind: str, make: Callable[[], Reference]) -> Reference:
        """A reference from the disk, or made and kept there."""
        found = self.state.one(kind)
        image = self.state.image(found["image"]) if found else None
        if found and image is not None:
            names = ("variance", "spp", "passes", "seconds", "about")
            return Reference(image, *(found[name] for name in names))
        made = make()
        values = {k: v for k, v in asdict(made).items() if k != "image"}
        self._add(kind, **values, noise=made.noise, image=self.state.keep(kind, made.image))
        self.tell(f"{kind}: {made.about}" + (f", noise {made.noise:.2%}" if made.variance else ""), True)
        return made

    def _search(self) -> Search:
        subject = self.subject
        scenes = {name: subject.load(Point("raymarch", 1, representation=name), self.picture)
                  for name in ("grid", "network")}
        check = self.state.one("check") or {}
        pixels = np.prod([n // self.picture.shrink for n in subject.size])

        def predict(point: Point) -> tuple[float, float]:
            if point.method == STOCK:
                return 0.0, check["seconds_per_ray"] * float(pixels) * point.spp
            found = subject.predicted(point, scenes[point.representation])
            return found["build"], found["render"]

        methods = [name for name in REGISTRY if subject.serves[name]]
        methods += [STOCK] if "seconds_per_ray" in check else []
        search = Search(subject.base, methods, subject.limits, predict, self.budget)
        self._inform(search)
        return search

    def _inform(self, search: Search) -> None:
        """Tell the search what is known; the bias of a point is that of all points of its settings."""
        rows = [(from_dict(row["point"]), row) for row in self.points]
        for point, row in rows:
            if row["reason"]:
                search.add(point, Result(failed=True))
                continue
            alike = [reading.error(r) for p, r in rows if p.settings == point.settings and not r["reason"]]
            search.add(point, Result(row["build"], row["render"], row["noise"], errors.pooled(alike).bias))

    def _try(self, proposal: Proposal) -> None:
        """Measure a point, or note why it failed."""
        point, name = proposal.point, name_of(proposal.point.as_dict())
        row: dict[str, Any] = {"name": name, "point": point.as_dict(), "why": proposal.why, "reason": "",
                               "label": label(point, self.subject.base)}
        if self.state.attempts(name) >= ATTEMPTS:
            self._add("point", **row | {"reason": f"the process ended {ATTEMPTS} times while it was measured"})
            return
        self.state.add("begun", name=name)
        try:
            row |= self._measured(point, name, self._patience(proposal))
        except KeyboardInterrupt:
            self.state.add("interrupted", name=name)
            raise
        except Exception as error:
            row["reason"] = sentence(error)
        found = self._add("point", **row)
        self.tell(_told(found), True)

    def _patience(self, proposal: Proposal) -> float:
        """Seconds that one picture may take."""
        share = max(PATIENCE * proposal.seconds, LEAST_PATIENCE * self.budget)
        return max(5.0, min(share, self.budget - self.spent))

    def _measured(self, point: Point, name: str, timeout: float) -> dict[str, Any]:
        """The figures of a point's row."""
        assert self.reference is not None
        images, timing = measure(self.subject, point, self.picture, timeout)
        found = errors.split(images, self.reference.image, self.reference.variance)
        row: dict[str, Any] = {**asdict(timing), "noise": found.noise, "bias": found.bias,
                               "uncertainty": found.uncertainty, "error": found.total,
                               "image": self.state.keep(name, images[0])}
        if self.mesh:
            row["mesh_error"] = errors.split(images, self.mesh.image, self.mesh.variance).total
        return row


def tradeoff(scene: Path, out: Path = Path("tradeoff"), parameters: dict[str, str] | None = None,
             budget: float = 300.0, reference: Path | None = None, quiet: bool = False,
             workers: Workers = Workers()) -> dict[str, Any]:  # noqa: B008
    """Study `scene` (with `parameters` for its $names) for `budget` seconds and write ``index.html``, ``tradeoff.csv``
    and ``tradeoff.json`` to `out`, where an interrupted study of the same scene goes on.

    reference  the path-traced mesh: an EXR picture or the XML file of its scene; None: what shipped scenes have
    quiet      no progress on stderr
    workers    who renders the passes of the reference; points are measured here

    Returns what ``tradeoff.json`` holds. Raises MiNtfError for what cannot be rendered, and KeyboardInterrupt as it
    comes, after the report of what is there.
    """
    workers.check()
    subject = Subject(scene, parameters or {})
    if reference is not None and not reference.is_file():
        raise MiNtfError(f"reference {reference} does not exist; give an EXR picture or the XML file of a mesh scene")
    files.make_folder(out)
    with report.progress(budget, quiet) as tell:
        study = Study(subject, out, budget, reference, tell, workers)
        try:
            study.run()
        finally:
            result = None
            if study.reference is not None:
                result = _result(study, scene)
                report.write(result, study, out)
    assert result is not None  # else the study has raised
    return result


def _key(subject: Subject, reference: Path | None) -> dict[str, Any]:
    """What findings hold for."""
    stamp = [str(reference), reference.stat().st_mtime_ns] if reference else None
    return {"scene": subject.key(), "version": __version__, "machine": model.machine(), "reference": stamp}


def _result(study: Study, scene: Path) -> dict[str, Any]:
    """All that is known, JSON-ready: rows, references, machine, and sentences that read them."""
    state, subject = study.state, study.subject
    last = state.findings[-1]
    end = last if last["kind"] == "end" else None
    width, height = (n // study.picture.shrink for n in subject.size)
    rows = [dict(row) for row in study.points]
    reading.mark_front(rows)
    plain = ("kind", "image", "spent")
    return {
        "scene": str(scene), "parameters": subject.parameters, "size": [width, height],
        "scene_size": list(subject.size), "picture": (state.one("picture") or {}).get("about", ""),
        "base": subject.base.as_dict(), "scene_visibility": subject.visibility, "budget_seconds": study.budget,
        "spent_seconds": study.spent, "finished": end is not None,
        "machine": {"what": model.machine(), "mitsuba": mi.__version__, "version": __version__},
        "references": {kind: {k: v for k, v in found.items() if k not in plain}
                       for kind in ("reference", "check", "mesh") if (found := state.one(kind))},
        "points": rows, "skipped": end["skipped"] if end else [], "reading": reading.reading(rows),
    }


def _skipped(proposal: Proposal, subject: Subject) -> dict[str, Any]:
    return {"label": label(proposal.point, subject.base), "point": proposal.point.as_dict(),
            "reason": f"skipped: measuring it would take about {proposal.cost:.0f} s, which were not left"}


def _told(row: dict[str, Any]) -> str:
    """A point in one line."""
    if row["reason"]:
        return f"{row['label']}: {row['reason']}"
    return (f"{row['label']}: {row['build'] + row['render']:.2f} s, error {row['error']:.1%} "
            f"(noise {row['noise']:.1%}, bias {row['bias']:.1%})")
