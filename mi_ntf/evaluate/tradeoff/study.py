"""``mi-ntf tradeoff``: the study of one scene, from its references to its report."""

import statistics
import sys
import threading
import time
from pathlib import Path
from typing import Any

import mitsuba as mi

from ... import __version__
from ...core import files, interruption
from ...core.errors import MiNtfError, sentence
from ...render.machine import machine
from .. import mesh_reference
from ..budget import Tell, progress
from ..exported_mesh import ExportedMesh
from ..kept import State
from ..recipes import integrator_xml, render_command
from . import errors, references, report
from .errors import Truth
from .measure import TIMES, Renderer, follow
from .ways import BOUND, MESH, Subject, Way, plan

print_table = report.print_table

REFERENCE = 0.2
"""Share of the budget for the reference. All errors are held against it, so that it has twice the time that one of ten
ways gets."""


class Study:
    """Run of a study, which takes over what an earlier run of the same study has finished.

    `out`, `budget` and `reference` are those of :func:`tradeoff`; `tell` hears of the progress; `pressed` is set by
    Ctrl-C (:mod:`mi_ntf.core.interruption`).
    """

    def __init__(self, subject: Subject, out: Path, budget: float, reference: Path | None, tell: Tell,
                 pressed: threading.Event):
        self.subject, self.budget, self._tell, self._pressed = subject, budget, tell, pressed
        self._mesh_path, self._must_have_mesh = reference or mesh_reference.shipped(subject.path, subject.parameters), (
            reference is not None)
        stamp = reference and [str(reference), reference.stat().st_mtime_ns]
        self.state = State(out, {"scene": subject.key(), "version": __version__, "machine": machine(),
                                 "budget": budget, "reference": stamp})
        self._start = time.perf_counter() - max(line.get("clock", 0.0) for line in self.state.lines.values())
        self.truth: Truth | None = None
        self.mesh: Truth | None = None
        if self.state.fresh:
            self.tell(f"begins anew, since what lies in {out} is of another {self.state.fresh}", True)
        elif rows := self.lines("way"):
            self.tell(f"goes on; {len(rows)} ways are finished", True)

    @property
    def spent(self) -> float:
        """Seconds of the budget that are used, those of earlier runs included."""
        return time.perf_counter() - self._start

    def lines(self, kind: str) -> list[dict[str, Any]]:
        """Return what is known of each ``way`` or each ``probe``, the render that shows how steady the machine is."""
        return [line for name, line in self.state.lines.items() if name.startswith(f"{kind} ")]

    def tell(self, text: str, done: bool = False) -> None:
        """Say what is done now, or was done."""
        self._tell(self.spent, text, done)

    def run(self) -> None:
        """Do all that is not done yet."""
        shrink, marching = self._prepare()
        if "end" in self.state.lines:
            return
        marching(1, 1)  # compiles and builds, where an earlier run has rendered the reference
        self._probe(marching)
        ways = [way for way in plan(self.subject, self.mesh is not None) if f"way {way.name}" not in self.state.lines]
        left_out = []
        for i, way in enumerate(ways):
            always = sum(not w.changes for w in ways[i:])
            left = max(self.budget - self.spent, 0.0)
            more = max(0, min(int(left / TIMES[-1]) - always, len(ways) - i - always))
            if way.changes and not more:
                left_out.append(way.title)
                continue
            # Whatever the ways before have used, each has some time.
            self._try(way, shrink, max(left / (always + more), self.budget / 40))
            self._probe(marching)
        self._add("end", {"left_out": left_out})

    def _add(self, name: str, values: dict[str, Any]) -> None:
        """Keep a line, unless Ctrl-C has spoilt it: Mitsuba may have turned that into an error of another kind."""
        if self._pressed.is_set():
            raise KeyboardInterrupt
        self.state.add(name, {**values, "clock": self.spent})

    def _prepare(self) -> tuple[int, Renderer]:
        """Find the size of the picture, and the references. Return the former and what renders the reference."""
        subject, lines, share = self.subject, self.state.lines, REFERENCE * self.budget
        if "picture" not in lines:
            self.tell("how large a picture the budget allows")
            self._add("picture", {"shrink": references.choose_shrink(subject, share / 2)})
        shrink = lines["picture"]["shrink"]
        width, height = subject.pixels(shrink)
        render = references.renderer(subject, references.marched(subject), shrink)
        if "reference" not in lines or not self.state.pictures("reference"):
            made, rate = references.converge(render, width * height, max(share - self.spent, 0.0), self.tell)
            self.state.keep("reference", {"image": made.image})
            self._add("reference", {"variance": made.variance, "noise": made.noise, "about": made.about,
                                    "probe": max(1, int(0.25 / rate))})
            self.tell(f"reference: {made.about}, noise {made.noise:.2%}", True)
        known = lines["reference"]
        self.truth = Truth(self.state.pictures("reference")["image"], known["variance"], known["about"])
        if self._mesh_path:
            try:
                self.mesh = references.captured(subject, self._mesh_path, shrink, share / 5)
            except MiNtfError as error:
                if self._must_have_mesh:
                    raise
                self.tell(f"no mesh to compare with: {error}", True)
        return shrink, render

    def _probe(self, render: Renderer) -> None:
        """Time a small render, always the same."""
        _, took = render(self.state.lines["reference"]["probe"], 1)
        self._add(f"probe {len(self.lines('probe'))}", {"seconds": took})

    def _try(self, way: Way, shrink: int, share: float) -> None:
        """Measure a way, or note why it failed."""
        assert self.truth is not None
        row: dict[str, Any] = {"way": way.name, "method": way.method, "title": way.title, "finer": bool(way.changes),
                               "points": [], "reason": "", "note": "", "command": ""}
        self.tell(way.title)
        try:
            scene, properties = None, way.properties(self.subject)
            row["xml"] = integrator_xml(way.plugin, properties)
            if way.method == MESH:
                made = ExportedMesh(self.subject.scene(shrink), self.subject.media, self.state.folder)
                scene, row["command"], row["xml"] = made.scene, made.commands, row["xml"] + made.shapes
                row["note"] = (f"Making the mesh took {made.seconds:.0f} s, which are not counted, as those of the "
                               "field's voxels are not for the other ways. ")
            render = references.renderer(self.subject, way, shrink, scene)
            curve = follow(render, self.truth, self.mesh, share, lambda e: self.tell(f"{way.title}: error {e:.1%}"))
            end = curve.points[-1]
            if len(curve.points) == 1:
                row["note"] += (f"A single pass takes longer than this way's share of the budget, {share:.0f} s, so "
                                "that its noise and bias are not known.")
            if way.plugin == "nrf":
                row["command"] = render_command(self.subject.path, self.subject.parameters, properties, end["samples"])
            self.state.keep(way.name, curve.pictures)
            row |= {"points": curve.points, "shift": curve.shift, "compile": render.compile, "peak": render.peak}
            text = f"error {end['error']:.1%} after {end['seconds']:.1f} s"
        except Exception as error:
            row["reason"] = text = sentence(error)
        self._add(f"way {way.name}", row)
        self.tell(f"{way.title}: {text}", True)

    def result(self) -> dict[str, Any]:
        """Return what ``tradeoff.json`` holds."""
        lines, subject, rows = self.state.lines, self.subject, self.lines("way")
        points = [p for row in rows if row["method"] != BOUND for p in row["points"]]
        ends = errors.front([(p["seconds"], p["error"]) for p in points])
        for i, point in enumerate(points):
            point["front"] = i in ends
        probes, path = [probe["seconds"] for probe in self.lines("probe")], subject.path.resolve()
        spread = statistics.stdev(probes) / statistics.mean(probes) if len(probes) > 1 else None
        return {
            "scene": str(subject.path), "title": f"{path.parent.name}/{path.name}", "parameters": subject.parameters,
            "size": subject.pixels(lines["picture"]["shrink"]), "scene_size": subject.size,
            "budget_seconds": self.budget, "spent_seconds": self.spent, "finished": "end" in lines,
            "machine": {"what": machine(), "mitsuba": mi.__version__, "probe_seconds": probes, "spread": spread},
            "reference": lines["reference"], "mesh": self.mesh and self.mesh.about, "ways": rows,
            "left_out": lines.get("end", {}).get("left_out", []),
        }


def tradeoff(scene: Path, out: Path = Path("tradeoff"), parameters: dict[str, str] | None = None,
             budget: float = 300.0, reference: Path | None = None, quiet: bool = False) -> dict[str, Any]:
    """Study what accuracy costs on a scene, and write ``index.html``, ``tradeoff.csv`` and ``tradeoff.json``.

    Parameters
    ----------
    scene, parameters
        XML file with an ``nrf`` integrator, and values of its $names.
    out
        Folder for the report, where an interrupted study goes on.
    budget
        Seconds.
    reference
        The captured mesh, an EXR picture or the XML file of its scene; None: what shipped scenes have.
    quiet
        True: no progress on stderr.

    Returns what ``tradeoff.json`` holds. Raises MiNtfError where the scene cannot be rendered, and KeyboardInterrupt as
    it comes, after the report of what is there.
    """
    if reference is not None and not reference.is_file():
        raise MiNtfError(f"reference {reference} does not exist; give an EXR picture or the XML file of a mesh scene")
    study: Study | None = None
    with interruption.noticed() as pressed:
        try:
            subject = Subject(scene, parameters or {})
            files.make_folder(out)
            with progress(budget, quiet) as tell:
                study = Study(subject, out, budget, reference, tell, pressed)
                study.run()
        except BaseException:
            if not pressed.is_set():
                raise
            done = f"{len(study.lines('way'))} ways are finished; " if study else ""
            print(f"mi-ntf: interrupted; {done}the same command goes on", file=sys.stderr)
            raise KeyboardInterrupt from None
        finally:
            if study and study.truth is not None:
                pictures = {row["way"]: study.state.pictures(row["way"]) for row in study.lines("way")}
                report.write(study.result(), study.truth.image, pictures, out)
    return study.result()
