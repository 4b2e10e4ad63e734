"""The training loop: photographs in, one field file out."""

import copy
import dataclasses
import hashlib
import json
import math
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

import numpy as np
import torch

from ..core import field_file, files
from ..core.architecture import Header
from ..core.errors import MiNtfError
from ..data.schema import fingerprint
from . import checkpoint, device, held_out, networks, parallel, scoring
from .checkpoint import State
from .config import Config, FastConfig, configured, transmittance_alone
from .fast import Fast
from .hierarchical import Hierarchical
from .monitor import Display, Fault, Log, Notes, Validation
from .recipe import SCORING_TIME, Clock, Learner, Recipe, Run, Snapshot, copy_into
from .report import Report, judge, publish
from .scoring import FieldView
from .training_data import Reading, TrainingData

KEEP = 128
"""Steps between two copies of the run's state in memory, to which a fault rolls back."""
INTERVAL = 50.0
"""Seconds between two checkpoints, each the latest copy in memory …"""
LATEST = 75.0
"""… or, where steps are slow, a copy made for it after this time."""
FAULTS = 3
"""Rolled-back faults after which the next one ends the run."""
VALIDATED = 1 << 17
"""Pixels of a validation during the run."""
SCORED = 1 << 14
"""Least number of pixels by which a split of the finished field is scored, in the shortest runs."""
BETTER = 0.02
"""Validation gain, dB, for which an earlier field replaces the last one."""


def train(dataset: Path, out: Path, *, preset: str = "fast", minutes: float | None = None, steps: int | None = None,
          seed: int = 0, tensorboard: Path | None = None, field: Path | None = None, reading: Reading | None = None,
          estimate: bool = False, view: bool = False, ntf: str | None = None, augmentation: bool = True,
          colour_loss: bool = True, visibility_mlp: bool = False, bounces: bool = True, fresnel: bool = True,
          gains: bool = True) -> Report:
    """Train a field on the photographs in `dataset`, write it to `out`, and return the report, which its header holds.

    Parameters
    ----------
    minutes, steps
        Limit of the run, one of them; 10 minutes by default. Runs given in steps are reproducible to the last bit.
    tensorboard
        Folder for TensorBoard events.
    field
        Field file to keep as it is; its transmittance networks alone are trained, from the beginning.
    reading
        Options of :func:`mi_ntf.data.readers.load_dataset`.
    estimate
        Estimate the position of the flash beside the lens.
    view
        Show the field in a browser while it learns.
    ntf, augmentation, colour_loss, visibility_mlp, bounces, fresnel, gains
        Changes of the preset, see :func:`mi_ntf.train.config.configured`.

    Notes
    -----
    A checkpoint ``OUT.ckpt`` is written every minute. The same command continues it, and it is deleted at the end.
    Faults (:class:`mi_ntf.train.monitor.Fault`) are rolled back and listed in the report; several of them end the run.

    Under ``torchrun --nproc-per-node=N -m mi_ntf train …`` N processes share the work of every step, see
    :mod:`mi_ntf.train.parallel`. The first one prints and writes; the others return an empty report.
    """
    config = configured(preset, ntf=ntf, augmentation=augmentation, colour_loss=colour_loss,
                        visibility_mlp=visibility_mlp, bounces=bounces, fresnel=fresnel, gains=gains)
    finished = None if field is None else FinishedField.load(field)
    if finished is not None:
        config = transmittance_alone(config, finished.header.architecture)
    if minutes is not None and steps is not None:
        raise MiNtfError(f"both --minutes {minutes:g} and --steps {steps} are given; a run is limited by one of them")
    limit = steps if steps is not None else 10.0 if minutes is None else minutes
    if not (limit > 0 and math.isfinite(limit)):
        raise MiNtfError(f"--{'minutes' if steps is None else 'steps'} is {limit:g}; it must be positive")
    with device.chosen(), parallel.processes():
        if parallel.first():
            files.check(out)
        torch.set_num_threads(_threads() if steps is None and parallel.count() == 1 else 1)
        trainer = Trainer(Path(dataset), Path(out), config, preset, minutes=None if steps is not None else float(limit),
                          steps=steps, seed=seed, tensorboard=tensorboard, finished=finished, reading=reading,
                          estimate=estimate, view=view)
        trainer.resume()
        trainer.loop()
        return trainer.finish() if parallel.first() else {}


@dataclass(frozen=True)
class FinishedField:
    """A field file whose density and reflectance a run keeps."""

    path: Path
    header: Header
    tensors: dict[str, np.ndarray]

    @classmethod
    def load(cls, path: Path) -> "FinishedField":
        """Read the field file `path`. Raises MiNtfError."""
        return cls(path, *field_file.load(path))

    def check(self, data: TrainingData) -> None:
        """Raise MiNtfError if the field was not trained on the data set `data`."""
        here, there = ((*s.center, s.radius) for s in (data.similarity, self.header.similarity))
        if max(abs(a - b) for a, b in zip(here, there, strict=True)) > 1e-4 * data.similarity.radius:
            raise MiNtfError(f"{self.path} has its unit sphere (centre, radius) at {there}, the data set has it at "
                             f"{here}; --field needs the data set that the field was trained on")


class FaultEntry(TypedDict):
    """Entry of the list of faults."""

    step: int
    reason: str


class Best(TypedDict):
    """The field of the best validation so far."""

    psnr: float
    entry: Validation
    snapshot: Snapshot


@dataclass
class Record:
    """Course of a run; part of checkpoints."""

    history: list[Validation] = field(default_factory=list)
    trace: list[tuple[int, float]] = field(default_factory=list)
    """Steps and running means of the loss, a hundred in a run."""
    faults: list[FaultEntry] = field(default_factory=list)
    validated: float = 0.0  # Progress at the last validation
    best: Best | None = None
    chosen: Validation | None = None
    """Validation of the finished field; None before."""


class Trainer:
    """Training run: it has a recipe, and adds the loop, validation, roll-backs, checkpoints and reports.

    Parameters are those of :func:`train`. A checkpoint of the same run is continued by :meth:`resume`.
    """

    def __init__(self, dataset: Path, out: Path, config: Config, preset: str, *, minutes: float | None = None,
                 steps: int | None = None, seed: int = 0, tensorboard: Path | None = None,
                 finished: FinishedField | None = None, reading: Reading | None = None, estimate: bool = False,
                 view: bool = False):
        start = time.monotonic()
        self.log = Log(tensorboard if parallel.first() else None, view and parallel.first())
        self.notes = Notes(parallel.first())
        reading = reading or {}
        if estimate and reading.get("flash_offset") is None:
            reading = {**reading, "flash_offset": "estimate"}
        self.data = TrainingData.load(dataset, self.notes, reading)
        self.clock = Clock(minutes or math.inf, steps or math.inf, spent=time.monotonic() - start)
        self.learner = Learner(self.clock)
        self.generator = device.generator(seed)
        if finished is not None:
            finished.check(self.data)
        run = Run(self.data, self.clock, self.learner, self.notes, self.generator)
        self.recipe: Recipe
        if isinstance(config, FastConfig):
            self.recipe = Fast(config, run, estimate, None if finished is None else finished.tensors)
        else:
            self.recipe = Hierarchical(config, run, estimate)
        self.out, self.checkpoint, self.finished = out, Path(f"{out}.ckpt"), finished
        digest = None if finished is None else hashlib.sha256(finished.path.read_bytes()).hexdigest()
        self.settings: State = {"preset": preset, "minutes": minutes, "steps": steps, "seed": seed,
                                "views": {k: len(s.images) for k, s in self.data.splits.items()}}
        identity = self.settings | {"config": dataclasses.asdict(config), "field": digest, "estimate": estimate,
                                    "data": fingerprint(self.data.splits)}
        self.identity: State = json.loads(json.dumps(identity, sort_keys=True))
        self.record = Record()
        self.good: State = {}  # Latest good state of the run
        self.speed = 0.0  # Pixels a second of the last validation
        self.last = math.nan  # PSNR of the last validation, dB
        self.saved = time.monotonic()  # Time of the last checkpoint

    def loop(self) -> None:
        """Step until the limit; show progress, validate, save checkpoints, roll back faults."""
        clock = self.clock
        if not clock.step and self.finished is None:
            self.recipe.carve()
        self.log.start(clock.step)
        self.keep()
        self.saved, traced, average = time.monotonic(), clock.progress, math.nan
        with Display(parallel.first()) as display:
            try:
                while clock.progress < 1:
                    try:
                        value = self.turn(display)
                    except Fault as fault:
                        display.say(self.roll_back(fault))
                        continue
                    average = value if math.isnan(average) else 0.98 * average + 0.02 * value
                    if clock.progress - traced > 0.01:
                        traced = clock.progress
                        self.record.trace.append((clock.step, average))
                    if clock.step % 20 == 0:
                        display.update(clock.progress, clock.step, average)
                    if self.due():
                        self.save()
                        self.saved = time.monotonic()
                if self.record.chosen is None:  # field and transmittance have learnt together to the end
                    display.validated(self.validate())
                    display.say(self.choose())
                display.update(clock.progress, clock.step, 0.0 if math.isnan(average) else average)
            except KeyboardInterrupt:
                self.save()
                raise
        self.log.close()

    def turn(self, display: Display) -> float:
        """Take one step, do what is due around it, and return the loss. Raises Fault."""
        start, clock, record = time.monotonic(), self.clock, self.record
        finished = clock.progress >= self.recipe.field_until
        validate = record.chosen is None if finished else clock.progress - record.validated > 0.1
        if validate:
            record.validated = clock.progress
            display.validated(self.validate())
            if finished:
                display.say(self.choose())
        value = self.recipe.advance()
        clock.step += 1
        if clock.step % 20 == 0:
            self.log_scalars()
            self.log.show(clock.step, self.last, self.picture)
        clock.spent += time.monotonic() - start
        if clock.timed:
            clock.spent = parallel.agreed(clock.spent)
            if validate:
                record.validated = clock.progress  # the next validation is a tenth of the run later than its end
        if clock.step % KEEP == 0 or clock.progress >= 1 or self.due():
            self.keep()
        return value

    def due(self) -> bool:
        """Return True if it is time for a checkpoint. Processes whose clocks differ copy states at the same steps."""
        age = time.monotonic() - self.saved
        if self.clock.step % KEEP == 0:
            return age >= INTERVAL
        return age >= LATEST and parallel.count() == 1

    def log_scalars(self) -> None:
        """Write losses and learning rates to TensorBoard."""
        learner = self.learner
        values = {f"loss/{k}": float(v.detach()) for k, v in learner.terms.items()}
        values |= {f"learning rate/{k}": float(o.param_groups[0]["lr"]) for k, o in learner.optimizers.items()}
        self.log.scalars(self.clock.step, values, learner.rays, learner.samples)

    @property
    def view(self) -> FieldView:
        """The field as learned so far, ready to be rendered."""
        recipe = self.recipe
        return FieldView(recipe.networks, recipe.occupied(), recipe.config.step, recipe.light)

    def validate(self) -> Validation:
        """Measure the PSNR of some validation views, and remember the field if it is the best so far."""
        pool, start, record = self.data.photographs["val"], time.monotonic(), self.record
        views = min(4, pool.views)
        self.last = scoring.score(self.view, pool, VALIDATED, views, 1).srgb
        self.speed = min(VALIDATED, views * pool.height * pool.width) / max(time.monotonic() - start, 1e-6)
        entry: Validation = {"step": self.clock.step, "psnr": round(self.last, 4)}
        record.history.append(entry)
        self.log.validated(entry, self.picture)
        if record.best is None or self.last > record.best["psnr"]:
            record.best = {"psnr": self.last, "entry": entry, "snapshot": self.recipe.snapshot()}
        return entry

    def picture(self) -> torch.Tensor:
        """Return a small picture (h, w, 3), sRGB: a held-out photograph, the field's, and its normals."""
        pool = self.data.photographs["val"]
        pixels, rows, columns = pool.frame(0, max(1, round(max(pool.height, pool.width) / 256)))
        rays = pool[pixels]
        rendered = self.view.render(rays, device.generator(2))
        parts = scoring.srgb(rays.target[:, :3]), scoring.srgb(rendered.color), (rendered.normal + 1) / 2
        return torch.cat([p.view(rows, columns, 3) for p in parts], 1).clamp(0, 1)

    def choose(self) -> str:
        """Finish the field, which is that of the best validation if the last one is worse; return a message."""
        record, step = self.record, self.clock.step
        best, record.best = record.best, None
        record.chosen = record.history[-1]
        if best is None or best["psnr"] - self.last <= BETTER:
            return f"step {step}: the field is finished"
        record.chosen = best["entry"]
        self.recipe.adopt(best["snapshot"])
        return (f"step {step}: the field is finished; the one of step {record.chosen['step']} is kept, since it is "
                f"better by {best['psnr'] - self.last:.2f} dB in validation")

    def state(self) -> State:
        """Return a copy of all that decides the next step: a run that restores it is the same run."""
        return copy.deepcopy({
            "step": self.clock.step, "spent": self.clock.spent, "record": vars(self.record), "notes": self.notes.texts,
            "random": self.generator.get_state(), "learner": self.learner.state(), "recipe": self.recipe.state(),
            "parameters": {k: v.detach() for k, v in self.recipe.parameters().items()}})

    def restore(self, state: State) -> None:
        """Restore a :meth:`state`."""
        state = copy.deepcopy(state)
        copy_into(self.recipe.parameters(), state["parameters"])
        self.recipe.restore(state["recipe"])
        self.learner.restore(state["learner"])
        self.clock.step, self.clock.spent = state["step"], state["spent"]
        self.record, self.notes.texts = Record(**state["record"]), state["notes"]
        self.generator.set_state(state["random"].cpu())

    def keep(self) -> None:
        """Copy the state as one to go back to. Raises Fault if a parameter is not finite."""
        for name, value in self.recipe.parameters().items():
            if not bool(value.isfinite().all()):
                raise Fault(f"{name} is not finite at step {self.clock.step}")
        self.good = self.state()

    def roll_back(self, fault: Fault) -> str:
        """Go back to the last good state with half the learning rates and return a message.

        Random numbers go on, so that the same batch does not come again. Raises MiNtfError after too many faults.
        """
        entry: FaultEntry = {"step": self.clock.step, "reason": str(fault)}
        faults, spent, factor = [*self.record.faults, entry], self.clock.spent, self.learner.factor / 2
        random = self.generator.get_state()
        if len(faults) > FAULTS:
            if parallel.first():
                checkpoint.delete(self.checkpoint)
            raise MiNtfError(f"training diverged {len(faults)} times, although the learning rate was halved each "
                             f"time: {fault}; nothing was written to {self.out}. Try another --seed; if it persists, "
                             "check the light intensities")
        self.restore(self.good)
        self.record.faults, self.clock.spent, self.learner.factor = faults, spent, factor
        self.generator.set_state(random)
        self.keep()
        return f"{fault}: back to step {self.clock.step}, learning rates × {factor:g}"

    def save(self) -> None:
        """Write the last good state as a checkpoint."""
        if parallel.first():
            checkpoint.write(self.checkpoint, self.identity, self.good)

    def resume(self) -> None:
        """Continue a checkpoint if there is one. Raises MiNtfError if it belongs to another run."""
        state, reading = checkpoint.read(self.checkpoint, self.identity), self.clock.spent
        if state is not None:
            self.restore(state)
            self.clock.spent += reading
        step = self.clock.step
        if parallel.agreed(step) != step:
            raise MiNtfError(f"{self.checkpoint} is at step {step} for this process and at another for the first; "
                             "put it where all processes see it, or delete it")

    def finish(self) -> Report:
        """Write the field, read it back, measure it, and store the report in its header."""
        data, recipe, record = self.data, self.recipe, self.record
        architecture, tensors = recipe.config.architecture, networks.to_tensors(recipe.networks)
        report: Report = dict(self.settings)
        if self.finished is not None:
            report["field"] = self.finished.header.provenance
        report |= {"bounces": recipe.light.bounced is not None, "steps_done": self.clock.step,
                   "seconds": round(self.clock.spent, 1), "history": record.history, "kept": record.chosen,
                   "faults": record.faults}
        header = Header(architecture, data.similarity, report)
        field_file.save(self.out, header, tensors)
        stored = networks.from_tensors(architecture, field_file.load(self.out)[1])
        field = FieldView(stored, scoring.occupied(stored), recipe.config.step, recipe.light)
        # There is time to look at this many pixels of a split, of both splits twice each.
        most = max(SCORED, self.speed * 60 * self.clock.minutes * SCORING_TIME / 10) if self.clock.timed else math.inf
        with Display(parallel.first(), "score") as display:
            for i, name in enumerate(("val", "test")):
                def tell(done: float, splits: int = i) -> None:
                    display.update((splits + done) / 2)

                report[name] = scoring.score(field, data.photographs[name], most, tell=tell).rounded()
        report["transmittance"] = held_out.score(stored, field.occupancy, data.photographs["val"])
        gains = None if recipe.gains is None else recipe.gains.all().detach()
        agreement = judge(field, data, gains, self.notes, report, most)
        field_file.save(self.out, header, tensors)
        publish(field, data, gains, agreement, report, record.trace, self.out)
        checkpoint.delete(self.checkpoint)
        return report


def _threads() -> int:
    """Return the number of idle cores, 1 or 2: on a busy machine two threads that wait for each other are slow."""
    return 2 if (os.cpu_count() or 1) - os.getloadavg()[0] > 1.5 else 1
