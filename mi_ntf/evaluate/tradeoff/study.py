"""The study of one scene by `mi-ntf tradeoff`, from its references to its report."""

import statistics
import time
from pathlib import Path

import mitsuba as mi

from ... import __version__
from ...core import files, interruption, progress
from ...core.errors import MiNtfError, sentence
from ...render.machine import machine
from ...render.scene.environment_option import Environment
from ..exported_mesh import ExportedMesh
from ..kept import State
from ..limits import Json
from ..recipes import integrator_xml, render_command
from . import errors, references, report
from .errors import Truth
from .measure import TIMES, Renderer, follow
from .ways import BOUND, MESH, Subject, Way, plan

print_table = report.print_table

REFERENCE = 0.2
"""Fraction of the budget for the reference: twice the time of one of ten ways, since all errors are relative to it."""


class Study:
    """Run of a study, which continues an earlier run of the same study.

    `out`, `budget` and `reference` are those of :func:`tradeoff`.
    """

    def __init__(self, subject: Subject, out: Path, budget: float, reference: Path | None):
        self.subject, self.budget = subject, budget
        self._mesh_path = reference or (None if subject.env else references.shipped(subject.path, subject.parameters))
        self._needs_mesh = reference is not None
        stamp = self._mesh_path and [str(self._mesh_path), self._mesh_path.stat().st_mtime_ns]
        self.state = State(out, {"scene": subject.key(), "version": __version__, "machine": machine(),
                                 "budget": budget, "reference": stamp})
        self._start: float = time.perf_counter() - max(line.get("clock", 0.0) for line in self.state.lines.values())
        self.truth: Truth | None = None
        self.mesh: Truth | None = None
        if self.state.fresh:
            progress.say(f"begins anew, since {out} holds a study of another {self.state.fresh}")
        elif rows := self.lines("way"):
            progress.say(f"goes on: {len(rows)} ways are finished")

    @property
    def spent(self) -> float:
        """Seconds of the budget that are used, those of earlier runs included."""
        return time.perf_counter() - self._start

    def lines(self, kind: str) -> list[Json]:
        """Return the lines of each ``way``, or of each ``probe``, a render that shows the noise of the machine."""
        return [line for name, line in self.state.lines.items() if name.startswith(f"{kind} ")]

    def run(self) -> None:
        """Do the work that is not finished yet."""
        with progress.Stage("study", seconds=max(self.budget - self.spent, 1.0)) as self._stage:
            self._run()

    def _tell(self, text: str) -> None:
        """Show the work that is done now."""
        self._stage.update(0, text)

    def _say(self, text: str) -> None:
        """Print the work that is finished."""
        progress.say(f"{self.spent:5.0f} s  {text}")

    def _run(self) -> None:
        shrink, marching = self._prepare()
        if "end" in self.state.lines:
            return
        marching(1, 1)  # compiles and builds, where an earlier run has rendered the reference
        self._probe(marching)
        ways = [way for way in plan(self.subject, self.mesh is not None) if f"way {way.name}" not in self.state.lines]
        left_out = []
        for i, way in enumerate(ways):
            always = sum(not w.changes for w in ways[i:])
            remaining = max(self.budget - self.spent, 0.0)
            more = max(0, min(int(remaining / TIMES[-1]) - always, len(ways) - i - always))
            if way.changes and not more:
                left_out.append(way.title)
                continue
            # Each way has some time, even if those before it have used more than theirs.
            self._try(way, shrink, max(remaining / (always + more), self.budget / 40))
            self._probe(marching)
        self._add("end", {"left_out": left_out})

    def _add(self, name: str, values: Json) -> None:
        """Store a line, unless Ctrl-C was pressed."""
        interruption.check()
        self.state.add(name, {**values, "clock": self.spent})

    def _prepare(self) -> tuple[int, Renderer]:
        """Choose the size of the picture and make the references; return the former and the reference's renderer."""
        subject, lines, seconds = self.subject, self.state.lines, REFERENCE * self.budget
        if "picture" not in lines:
            self._tell("choice of the picture's size")
            whole = self._mesh_path is not None
            self._add("picture", {"shrink": references.choose_shrink(subject, seconds / 2, whole)})
        shrink = lines["picture"]["shrink"]
        width, height = subject.pixels(shrink)
        way = references.marched(subject)
        render = references.renderer(subject, way, shrink)
        if "reference" not in lines or not self.state.pictures("reference"):
            truth, rate = references.converge(render, width * height, int(way.properties(subject)["samples"]),
                                              max(seconds - self.spent, 0.0), self._tell)
            self.state.keep("reference", {"image": truth.image})
            self._add("reference", {"variance": truth.variance, "noise": truth.noise, "about": truth.about,
                                    "probe": max(1, int(0.25 / rate))})
            self._say(f"reference: {truth.about}, noise {truth.noise:.2%}")
        known = lines["reference"]
        self.truth = Truth(self.state.pictures("reference")["image"], known["variance"], known["about"])
        if self._mesh_path:
            try:
                self.mesh = references.captured(subject, self._mesh_path, shrink, seconds / 5)
            except MiNtfError as error:
                if self._needs_mesh:
                    raise
                self._say(f"no mesh to compare with: {error}")
        return shrink, render

    def _probe(self, render: Renderer) -> None:
        """Time a small render, the same in each call."""
        _, seconds, _ = render(self.state.lines["reference"]["probe"], 1)
        self._add(f"probe {len(self.lines('probe'))}", {"seconds": seconds})

    def _try(self, way: Way, shrink: int, seconds: float) -> None:
        """Measure a way for so many seconds, or store the reason of its failure."""
        assert self.truth is not None
        row: Json = {"way": way.name, "method": way.method, "title": way.title, "finer": bool(way.changes),
                     "points": [], "reason": "", "note": "", "command": ""}
        self._tell(way.title)
        try:
            scene, properties = None, way.properties(self.subject)
            row["xml"] = integrator_xml(way.plugin, properties)
            if way.method == MESH:
                mesh = ExportedMesh(self.subject.scene(shrink), self.subject.media, self.state.folder)
                scene, row["command"], row["xml"] = mesh.scene, mesh.commands, row["xml"] + mesh.shapes
                row["note"] = (f"Making the mesh took {mesh.seconds:.0f} s, which are not counted, as those of the "
                               "field's voxels are not for the other ways. ")
            render = references.renderer(self.subject, way, shrink, scene)
            curve = follow(render, self.truth, self.mesh, seconds, lambda e: self._tell(f"{way.title}: error {e:.1%}"))
            end = curve.points[-1]
            if len(curve.points) == 1:
                row["note"] += (f"A second pass does not fit into this way's part of the budget, {seconds:.0f} s, so "
                                "its noise and bias are not known.")
            if way.plugin == "nrf":
                row["command"] = render_command(self.subject.path, self.subject.parameters, properties, end["samples"],
                                                self.subject.env)
            self.state.keep(way.name, curve.pictures)
            row |= {"points": curve.points, "shift": curve.shift, "compile": render.compile, "peak": render.peak}
            text = f"error {end['error']:.1%} after {end['seconds']:.1f} s"
        except Exception as error:
            if interruption.caused(error):
                raise KeyboardInterrupt from None
            row["reason"] = text = sentence(error)
        self._add(f"way {way.name}", row)
        self._say(f"{way.title}: {text}")

    def result(self) -> Json:
        """Return the content of ``tradeoff.json``."""
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
             budget: float = 300.0, reference: Path | None = None, environment: Environment | None = None) -> Json:
    """Study what accuracy costs on a scene, and write ``index.html``, ``tradeoff.csv`` and ``tradeoff.json``.

    Parameters
    ----------
    scene, parameters
        XML file with an ``nrf`` integrator, and values of its $names.
    out
        Folder for the report; an interrupted study there is continued.
    budget
        Seconds of the study.
    reference
        The captured mesh: an EXR picture, or the XML file of its scene. None stands for the file of shipped scenes.
    environment
        Changes of the scene's environment. Files of shipped scenes do not fit to them.

    Returns
    -------
    dict
        The content of ``tradeoff.json``.

    Raises
    ------
    MiNtfError
        If the scene cannot be rendered.
    KeyboardInterrupt
        After Ctrl-C, when the report of the measurements so far is written.
    """
    if reference is not None and not reference.is_file():
        raise MiNtfError(f"reference {reference} does not exist; give an EXR picture or the XML file of a mesh scene")
    study: Study | None = None
    try:
        with progress.Stage(f"reading {scene}"):
            subject = Subject(scene, parameters or {}, environment)
        files.make_folder(out)
        study = Study(subject, out, budget, reference)
        study.run()
    except KeyboardInterrupt:
        if study is None:
            raise
        raise KeyboardInterrupt(f"stopped; {len(study.lines('way'))} ways are finished, and the same command goes on"
                                ) from None
    finally:
        if study and study.truth is not None:
            pictures = {row["way"]: study.state.pictures(row["way"]) for row in study.lines("way")}
            report.write(study.result(), study.truth.image, pictures, out)
    return study.result()
