"""The training loop: photographs in, one field file out."""

import copy
import dataclasses
import json
import math
import os
import time
from pathlib import Path

import torch

from ..core import files, progress
from ..core.errors import MiNtfError
from ..data.schema import fingerprint
from . import checkpoint, device, parallel, scoring
from .checkpoint import State
from .config import Config, FastConfig, configured
from .fast import Fast
from .finish import finish
from .finished import FinishedField
from .hierarchical import Hierarchical
from .monitor import Fault, Log, Notes, Validation
from .pace import Pace
from .recipe import Clock, Learner, Recipe, Run, copy_into
from .record import FaultEntry, Record
from .report import Report
from .scoring import FieldView
from .training_data import Reading, TrainingData

KEEP = 128
"""Steps between two copies of the run's state in memory, to which a fault rolls back."""
INTERVAL = 50.0
"""Seconds between two checkpoints, each of which is the latest copy in memory."""
LATEST = 75.0
"""Seconds after which slow steps get a copy of their own for the checkpoint."""
FAULTS = 3
"""Rolled-back faults after which the next one ends the run."""


def train(dataset: Path, out: Path, *, preset: str = "fast", minutes: float | None = None, steps: int | None = None,
          seed: int = 0, tensorboard: Path | None = None, field: Path | None = None, further: bool = False,
          reading: Reading | None = None, estimate: bool = False, view: bool = False, ntf: str | None = None,
          augmentation: bool = True, colour_loss: bool = True, visibility_mlp: bool = False, bounces: bool = True,
          fresnel: bool = True, gains: bool = True, smoke: float | None = None, began: float | None = None) -> Report:
    """Train a field on the photographs in `dataset`, write it to `out`, and return the report, which its header holds.

    Parameters
    ----------
    minutes, steps
        Limit of the run, one of them; 10 minutes by default. Runs given in steps are reproducible to the last bit.
    tensorboard
        Folder for TensorBoard events.
    field
        Field file to keep as it is; its transmittance networks alone are trained, from the beginning.
    further
        Begin with the field in `out`, train all of it further, and replace it. It becomes no worse in validation.
    reading
        Options of :func:`mi_ntf.data.readers.load_dataset`.
    estimate
        Estimate the position of the flash beside the lens.
    view
        Show the field in a browser while it learns.
    ntf, augmentation, colour_loss, visibility_mlp, bounces, fresnel, gains, smoke
        Changes of the preset, see :func:`mi_ntf.train.config.configured`.
    began
        Moment of `time.monotonic` from which `minutes` count; by default that of the call.

    Notes
    -----
    A checkpoint ``OUT.ckpt`` is written every minute. The same command continues it, and it is deleted at the end.
    Faults (:class:`mi_ntf.train.monitor.Fault`) are rolled back and listed in the report; several of them end the run.

    Under ``torchrun --nproc-per-node=N -m mi_ntf train …`` N processes share the work of every step, see
    :mod:`mi_ntf.train.parallel`. The first one prints and writes; the others return an empty report.
    """
    config = configured(preset, ntf=ntf, augmentation=augmentation, colour_loss=colour_loss,
                        visibility_mlp=visibility_mlp, bounces=bounces, fresnel=fresnel, gains=gains, smoke=smoke)
    if further and field is not None:
        raise MiNtfError("--continue trains all of a field and --field its transmittance alone; give one of them")
    if further and not out.exists() and Path(f"{out}.ckpt").exists():
        raise MiNtfError(f"{out} is not finished yet; leave out --continue, and its training goes on")
    finished = FinishedField.load(out, True) if further else FinishedField.load(field) if field is not None else None
    if finished is not None:
        config = finished.configured(config, ntf)
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
                          estimate=estimate, view=view, began=began)
        return trainer.run()


class Trainer:
    """Training run: it has a recipe, and adds the loop, validation, roll-backs, checkpoints and reports.

    Parameters are those of :func:`train`. A checkpoint of the same run is continued by :meth:`resume`.
    """

    def __init__(self, dataset: Path, out: Path, config: Config, preset: str, *, minutes: float | None = None,
                 steps: int | None = None, seed: int = 0, tensorboard: Path | None = None,
                 finished: FinishedField | None = None, reading: Reading | None = None, estimate: bool = False,
                 view: bool = False, began: float | None = None):
        self.clock = clock = Clock(minutes or math.inf, steps or math.inf)
        clock.last = clock.last if began is None else began
        self.log = Log(tensorboard if parallel.first() else None, view and parallel.first())
        self.notes = Notes(parallel.first())
        reading = reading or {}
        if estimate and reading.get("flash_offset") is None:
            reading = {**reading, "flash_offset": "estimate"}
        with self.stage("reading photographs"):
            self.data = TrainingData.load(dataset, self.notes, reading)
        self.pace = Pace(clock, self.data)
        self.learner = Learner(self.clock)
        self.generator = device.generator(seed)
        if finished is not None:
            finished.check(self.data)
            clock.first = clock.step = finished.steps
            clock.begin = finished.begin(minutes, steps)
        self.parts = run = Run(self.data, self.clock, self.learner, self.notes, self.generator)
        self.recipe: Recipe
        if isinstance(config, FastConfig):
            with self.stage("preparing the field"):
                self.recipe = Fast(config, run, estimate, finished)
        else:
            self.recipe = Hierarchical(config, run, estimate)
        self.out, self.checkpoint, self.finished = out, Path(f"{out}.ckpt"), finished
        digest = None if finished is None else finished.digest()
        self.settings: State = {"preset": preset, "minutes": minutes, "steps": steps, "seed": seed,
                                "views": {k: len(s.images) for k, s in self.data.splits.items()}}
        identity = self.settings | {"config": dataclasses.asdict(config), "field": digest, "estimate": estimate,
                                    "data": fingerprint(self.data.splits)}
        self.identity: State = json.loads(json.dumps(identity, sort_keys=True))
        self.record = Record()
        if finished is not None and finished.further:  # its field is the first to be validated
            self.record = Record(history=finished.header.provenance.get("history", []), validated=-1.0)
        self.good: State = {}  # Latest good state of the run
        self.last = math.nan  # PSNR of the last validation, dB
        self.saved = time.monotonic()  # Time of the last checkpoint

    def run(self) -> Report:
        """Continue a checkpoint if there is one, train to the limit, write the field and return its report."""
        self.resume()
        try:
            self.loop()
            return self.finish() if parallel.first() else {}
        except KeyboardInterrupt:
            if not self.good:
                raise
            self.save()
            clock = self.clock
            limit = f"{clock.minutes:g} min" if clock.timed else f"{clock.first + clock.steps:g}"
            raise KeyboardInterrupt(f"stopped at step {self.good['step']} of {limit}; the same command goes on"
                                    ) from None

    def finish(self) -> Report:
        """Write the field and its page, delete the checkpoint, and return the report."""
        report = finish(self.parts, self.recipe, self.record, self.pace, self.finished, self.settings, self.out)
        checkpoint.delete(self.checkpoint)
        return report

    def stage(self, title: str) -> progress.Stage:
        """Return the stage `title` of the run, whose time left is that of the run, or estimated if it has steps."""
        return progress.Stage(title, seconds=self.clock.left, shown=parallel.first())

    def loop(self) -> None:
        """Step until the limit; show progress, validate, save checkpoints, roll back faults."""
        clock = self.clock
        with self.stage("training") as stage:
            if not clock.step and self.finished is None:
                with progress.Stage("shaping the visual hull", inner=True):
                    self.recipe.carve()
            self.log.start(clock.step)
            self.keep()
            self.saved, traced, average = time.monotonic(), clock.progress, math.nan
            while clock.progress < 1 or clock.step == clock.first:  # a slow machine makes one step, too
                try:
                    value = self.turn()
                except Fault as fault:
                    self.say(self.roll_back(fault), warning=True)
                    continue
                average = value if math.isnan(average) else 0.98 * average + 0.02 * value
                if clock.progress - traced > 0.01:
                    traced = clock.progress
                    self.record.trace.append((clock.step, average))
                stage.update(clock.progress, f"step {clock.step}, loss {average:.3f}, validation " +
                             ("–" if math.isnan(self.last) else f"{self.last:.1f} dB"))
                if self.due():
                    self.save()
                    self.saved = time.monotonic()
            if self.record.chosen is None:  # field and transmittance have learnt together to the end
                self.validate()
                self.choose()
        self.log.close()

    def turn(self) -> float:
        """Take one step, do what is due around it, and return the loss. Raises Fault."""
        clock, record = self.clock, self.record
        finished = clock.progress >= self.recipe.field_until
        validate = record.chosen is None if finished else clock.progress - record.validated > 0.1
        if validate:
            record.validated = clock.progress
            self.validate()
            if finished:
                self.choose()
        value = self.recipe.advance()
        clock.step += 1
        if clock.step % 20 == 0:
            self.log_scalars()
            self.log.show(clock.step, self.last, self.picture)
        clock.count()
        if clock.timed and validate:
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

    def validate(self) -> None:
        """Measure the PSNR of some validation views, and remember the field if it is the best so far."""
        pool, record, field = self.data.photographs["val"], self.record, self.view
        views = min(4, pool.views)
        with progress.Stage("validating", inner=True):
            if self.pace.speed == math.inf:
                pixels = self.pace.rehearse(self.recipe.networks, field, pool, views)
                record.pixels = record.pixels if record.history else pixels
            self.last = self.pace.score(field, pool, record.pixels, views, 1).srgb
        if self.clock.progress < self.recipe.field_until:  # later, the schedule must not go back
            self.pace.reserve()
        entry: Validation = {"step": self.clock.step, "psnr": round(self.last, 4)}
        record.history.append(entry)
        self.log.validated(entry, self.picture)
        if record.best is None or self.last > record.best["psnr"]:
            record.best = {"psnr": self.last, "entry": entry, "snapshot": self.recipe.snapshot()}
        self.say(f"step {entry['step']}: validation {entry['psnr']:.2f} dB")

    def picture(self) -> torch.Tensor:
        """Return a small picture (h, w, 3), sRGB: a held-out photograph, the field's, and its normals."""
        pool = self.data.photographs["val"]
        pixels, rows, columns = pool.frame(0, max(1, round(max(pool.height, pool.width) / 256)))
        rays = pool[pixels]
        rendered = self.view.render(rays, device.generator(2))
        parts = scoring.srgb(rays.target[:, :3]), scoring.srgb(rendered.color), (rendered.normal + 1) / 2
        return torch.cat([p.view(rows, columns, 3) for p in parts], 1).clamp(0, 1)

    def choose(self) -> None:
        """Finish the field: that of the best validation."""
        record, step = self.record, self.clock.step
        best, record.best = record.best, None
        record.chosen = record.history[-1]
        text = f"step {step}: the field is finished"
        if best is not None and best["psnr"] > self.last:
            record.chosen = best["entry"]
            self.recipe.adopt(best["snapshot"])
            text += (f"; the one of step {record.chosen['step']} is kept, since it is better by "
                     f"{best['psnr'] - self.last:.2f} dB in validation")
        self.say(text)

    def say(self, text: str, warning: bool = False) -> None:
        """Print a line, in the first of several processes."""
        if parallel.first():
            progress.say(text, warning)

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
        state = checkpoint.read(self.checkpoint, self.identity)
        self.clock.tick()
        reading = self.clock.spent
        if state is not None:
            self.restore(state)
            self.clock.spent += reading
            self.say(f"goes on from step {self.clock.step}")
        step = self.clock.step
        if parallel.agreed(step) != step:
            raise MiNtfError(f"{self.checkpoint} is at step {step} for this process and at another for the first; "
                             "put it where all processes see it, or delete it")


def _threads() -> int:
    """Return the number of idle cores, 1 or 2: on a busy machine two threads that wait for each other are slow."""
    return 2 if (os.cpu_count() or 1) - os.getloadavg()[0] > 1.5 else 1
