"""The end of a run: the field is measured and written, with the report in its header, and a page beside it."""

import math
from pathlib import Path

from ..core import field_file, progress
from ..core.architecture import Header
from . import held_out, networks, report, scoring
from .finished import FinishedField
from .pace import Pace
from .recipe import Recipe, Run
from .record import Record
from .report import Report
from .scoring import FieldView
from .transmittance_targets import TransmittanceTargets


def finish(run: Run, recipe: Recipe, record: Record, pace: Pace, begun: FinishedField | None, settings: Report,
           out: Path) -> Report:
    """Measure the field as its file will hold it, write the file and the page, and return the report.

    `begun` is the field that the run began with. `settings` are the first entries of the report.
    """
    data, clock, architecture = run.data, run.clock, recipe.config.architecture
    tensors = field_file.rounded(networks.to_tensors(recipe.networks))
    stored = networks.from_tensors(architecture, tensors)
    result = dict(settings)
    if begun is not None and not begun.further:
        result["field"] = begun.header.provenance
    gains = None if recipe.gains is None else recipe.gains.all().detach()
    with progress.Stage("scoring the field", seconds=clock.left):
        field = FieldView(stored, scoring.occupied(stored), recipe.config.step, recipe.light)
        detail = pace.detail(report.scored_pixels(data) + report.page_pixels(data), 2 / 3 * pace.fixed)
        for name in ("val", "test"):
            pool = data.photographs[name]
            most = detail * len(pool) if detail < 1 else math.inf
            result[name] = pace.score(field, pool, most, pool.views, 2).rounded()
        marched = TransmittanceTargets()
        marched.update(stored, field.occupancy)
        result["transmittance"] = held_out.score(stored, marched, data.photographs["val"], detail)
        agreement = report.judge(field, data, gains, run.notes, result, detail)
    clock.tick()
    result |= {"bounces": recipe.light.bounced is not None, "steps_done": clock.step,
               "seconds": round(clock.spent + (0.0 if begun is None else begun.seconds), 1),
               "verdict": report.verdict(result["test"]["srgb"]), "history": record.history, "kept": record.chosen,
               "faults": record.faults}
    field_file.save(out, Header(architecture, data.similarity, result), tensors)
    with progress.Stage("writing the page", seconds=clock.left):
        detail = pace.detail(report.page_pixels(data), pace.fixed / 3)
        report.publish(field, data, gains, agreement, result, record.trace, marched, out, detail)
    return result
