"""The training loop: photographs in, one field file out."""

import dataclasses
import hashlib
import json
import math
import os
import time
from pathlib import Path

import torch

from ..core import field_file, files
from ..core.architecture import Header
from ..core.errors import MiNtfError
from ..data.schema import fingerprint
from . import checkpoint, device, held_out, networks, parallel, scoring
from .config import HierarchicalConfig, TrainConfig, configured, transmittance_alone
from .fast import Fast
from .hierarchical import Hierarchical
from .monitor import Display, Fault, Log
from .recipe import SCORING, Recipe
from .report import photographs, publish

KEEP = 128
"""Steps between two copies of the run's state in memory, to which a fault rolls back."""
INTERVAL = 50.0
"""Seconds between two checkpoints, each the latest copy in memory …"""
LATEST = 75.0
"""… or, where steps are slow, a copy made for it after so many."""
FAULTS = 3
"""Rolled-back faults after which the next one ends the run."""
VALIDATED = 1 << 17
"""Pixels of a validation in the course of the run."""
SCORED = 1 << 14
"""Pixels at least that a split of the finished field is scored by, in the shortest runs."""
BETTER = 0.02
"""dB by which an earlier field must be better in validation to be taken in place of the last one."""


def train(dataset: Path, out: Path, *, preset: str = "fast", minutes: float | None = None, steps: int | None = None,
          seed: int = 0, tensorboard: Path | None = None, field: Path | None = None, reading: dict | None = None,
          estimate: bool = False, view: bool = False, **variant) -> dict:
    """Train a field on the photographs in `dataset` and write it to `out`. Returns the report (JSON types).

    The run lasts `minutes` (10 unless told) or `steps`; runs given in steps are reproducible, bit for bit on one CPU.
    A checkpoint ``OUT.ckpt`` is written every minute, taken up by the same command, deleted at the end.
    Faults (see :class:`mi_ntf.train.monitor.Fault`) are rolled back, listed in the report, and end the run when they
    keep coming. `tensorboard`: a folder for its events. `view`: show the field in a browser while it learns. `field`:
    a field file to keep as it is; its transmittance networks alone are trained, anew. `reading`: options of
    :func:`mi_ntf.data.readers.load_dataset`. `estimate`: find where the flash stands beside the lens. `variant`:
    ablations, see :func:`config.configured`.

    Under ``torchrun --nproc-per-node=N -m mi_ntf train DATASET -o FIELD …`` (or any launcher that sets RANK,
    WORLD_SIZE, MASTER_ADDR and MASTER_PORT) N processes share the work of every step and average their gradients; see
    :mod:`mi_ntf.train.parallel`. It is the run of one process with the same seed, up to rounding. The first process
    prints and writes; the others return an empty report. All must see the same files.
    """
    config = configured(preset, **variant)
    given = None if field is None else field_file.load(field)
    if given is not None:
        config = transmittance_alone(config, given[0].architecture)
    if minutes is not None and steps is not None:
        raise MiNtfError(f"both --minutes {minutes:g} and --steps {steps} are given; a run is limited by one of them")
    limit = steps if steps is not None else 10.0 if minutes is None else minutes
    if not (limit > 0 and math.isfinite(limit)):
        raise MiNtfError(f"--{'minutes' if steps is None else 'steps'} is {limit:g}; it must be positive")
    with device.chosen(), parallel.processes():
        if parallel.first():
            files.check(out)
        torch.set_num_threads(_threads() if steps is None and parallel.count() == 1 else 1)
        kind = _HierarchicalRun if isinstance(config, HierarchicalConfig) else _Run
        before = None if field is None else hashlib.sha256(Path(field).read_bytes()).hexdigest()
        run = kind(Path(dataset), Path(out), config, preset, minutes=None if steps is not None else float(limit),
                   steps=steps, seed=seed, tensorboard=tensorboard, given=before, reading=reading, estimate=estimate,
                   view=view)
        if field is not None and given is not None:
            run.take(field, *given)
        run.resume()
        if not run.step and given is None:
            run.carve()
        run.loop()
        return run.finish() if parallel.first() else {}


class _Loop(Recipe):
    """One training run around a stepper, which a subclass adds: its loop, its validation, its files."""

    OWN = ("history", "validated", "best", "kept", "faults", "trace")

    def __init__(self, dataset: Path, out: Path, config: TrainConfig | HierarchicalConfig, preset: str, *, minutes,
                 steps, seed, tensorboard=None, given=None, reading=None, estimate=False, view=False):
        self.log = Log(tensorboard if parallel.first() else None, view and parallel.first())
        # The stepper's, next in line.
        super().__init__(dataset, config, minutes, steps, seed, reading, estimate)  # type: ignore[call-arg]
        self.out, self.checkpoint = out, Path(f"{out}.ckpt")
        identity = {"preset": preset, "minutes": minutes, "steps": steps, "seed": seed,
                    "config": dataclasses.asdict(config), "field": given, "estimate": estimate,
                    "views": {k: len(s.images) for k, s in self.splits.items()}, "data": fingerprint(self.splits)}
        self.identity = json.loads(json.dumps(identity, sort_keys=True))
        self.history: list[dict] = []
        self.trace: list[list[float]] = []
        """Step and running mean of the loss, now and then."""
        self.validated = 0.0
        self.faults: list[dict] = []
        self.best: dict | None = None
        """The field of the best validation so far."""
        self.saved = time.monotonic()
        """When the last checkpoint was written."""
        self.speed = 0.0
        """Pixels a second of the last validation."""
        self.last = float("nan")
        """PSNR of the last validation."""
        self.kept: dict | None = None
        """The validation of the field that was kept when it was finished; None before."""
        self.good: dict = {}
        """The latest good state of the run."""

    # --- the loop -------------------------------------------------------------------------------------------------

    def loop(self) -> None:
        """Step until the limit; show progress, validate, save checkpoints, roll back faults."""
        self.log.start(self.step)
        self.keep()
        self.saved, traced, average = time.monotonic(), self.progress(), None
        with Display(parallel.first()) as display:
            try:
                while self.progress() < 1:
                    try:
                        value = self.turn(display)
                    except Fault as fault:
                        display.say(self.roll_back(fault))
                        continue
                    average = value if average is None else 0.98 * average + 0.02 * value
                    if self.progress() - traced > 0.01:
                        traced = self.progress()
                        self.trace.append([self.step, average])
                    if self.step % 20 == 0:
                        display.update(self.progress(), self.step, average)
                    if self.due():
                        self.save()
                        self.saved = time.monotonic()
                if self.kept is None:  # field and transmittance have learnt together to the end
                    display.validated(self.validate())
                    display.say(self.choose())
                display.update(self.progress(), self.step, average or 0.0)
            except KeyboardInterrupt:
                self.save()
                raise
        self.log.close()

    def turn(self, display: Display) -> float:
        """One step and what is due around it; returns the loss. Raises Fault."""
        start = time.monotonic()
        finished = self.progress() >= self.config.ntf_alone
        validate = self.kept is None if finished else self.progress() - self.validated > 0.1
        if validate:
            self.validated = self.progress()
            display.validated(self.validate())
            if finished:
                display.say(self.choose())
        value = self.advance()
        self.step += 1
        if self.step % 20 == 0:
            self.log_scalars()
            self.log.look(self.step, self.last, self.picture)
        self.spent += time.monotonic() - start
        if self.minutes < math.inf:
            self.spent = parallel.agreed(self.spent)
        if validate and self.minutes < math.inf:
            self.validated = self.progress()  # however long it took, the next one is a tenth of the run away
        if self.step % KEEP == 0 or self.progress() >= 1 or self.due():
            self.keep()
        return value

    def due(self) -> bool:
        """Whether it is time for a checkpoint. Processes whose clocks differ copy their states at the same steps."""
        age = time.monotonic() - self.saved
        return age >= (INTERVAL if self.step % KEEP == 0 else LATEST if parallel.count() == 1 else math.inf)

    def log_scalars(self) -> None:
        values = {f"loss/{k}": float(v.detach()) for k, v in self.terms.items()}
        values |= {f"learning rate/{k}": o.param_groups[0]["lr"] for k, o in self.optimizers.items()}
        self.log.scalars(self.step, values, *self.trained)

    def validate(self) -> dict:
        """PSNR of some validation views with the current occupancy. Remembers the field if it is the best yet."""
        pool, start = self.photographs["val"], time.monotonic()
        views = min(4, pool.views)
        scores = scoring.score(self.nets, self.occupied(), pool, self.config.step, self.light, VALIDATED, views, 1)
        exact = scores["srgb"]
        self.speed = min(VALIDATED, views * pool.height * pool.width) / max(time.monotonic() - start, 1e-6)
        entry = {"step": self.step, "psnr": round(exact, 4)}
        self.history.append(entry)
        self.log.validated(entry, self.picture)
        if self.best is None or exact > self.best["psnr"]:
            self.best = {"psnr": exact, "entry": entry} | self.snapshot()
        self.last = exact
        return entry

    def picture(self) -> torch.Tensor:
        """A held-back photograph, the field's and its normals, side by side (h, w, 3), sRGB, small."""
        pool = self.photographs["val"]
        pixels, *shape = pool.frame(0, max(1, round(max(pool.height, pool.width) / 256)))
        seen = pool[pixels]
        color, _, normal, _ = scoring.render_all(self.nets, seen, self.occupied(), self.config.step,
                                                  device.generator(2), self.light)
        parts = scoring.srgb(seen.target[:, :3]), scoring.srgb(color), (normal + 1) / 2
        return torch.cat([p.view(*shape, 3) for p in parts], 1).clamp(0, 1)

    def choose(self) -> str:
        """The field is finished: go back to the best one in validation if that is not the last; says what was done."""
        self.kept = self.history[-1]
        best, self.best = self.best, None
        if best is None or best["psnr"] - self.last <= BETTER:
            return f"step {self.step}: the field is finished"
        kept = self.kept = best["entry"]
        self.adopt(best)
        return (f"step {self.step}: the field is finished; the one of step {kept['step']} is kept, since it is "
                f"better by {best['psnr'] - self.last:.2f} dB in validation")

    # --- state ----------------------------------------------------------------------------------------------------

    def keep(self) -> None:
        """Copy the state, to go back to. Raises Fault where a parameter is not finite."""
        for name, value in self.parameters().items():
            if not bool(value.isfinite().all()):
                raise Fault(f"{name} is not finite at step {self.step}")
        self.good = self.state()

    def roll_back(self, fault: Fault) -> str:
        """Go back to the last good state with half the learning rates; says so. The generator goes on, so that the same
        batch does not come again. Raises MiNtfError when there were too many faults."""
        entry = {"step": self.step, "reason": str(fault)}
        faults, spent, rate, random = [*self.faults, entry], self.spent, self.rate / 2, self.generator.get_state()
        if len(faults) > FAULTS:
            if parallel.first():
                checkpoint.delete(self.checkpoint)
            raise MiNtfError(f"training diverged {len(faults)} times, although the learning rate was halved each "
                             f"time: {fault}; nothing was written to {self.out}. Try another --seed; if it persists, "
                             "check the light intensities")
        self.restore(self.good)
        self.faults, self.spent, self.rate = faults, spent, rate
        self.generator.set_state(random)
        self.keep()
        return f"{fault}: back to step {self.step}, learning rates × {rate:g}"

    # --- files ----------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the checkpoint: the last good state."""
        if parallel.first():
            checkpoint.write(self.checkpoint, self.identity, self.good)

    def resume(self) -> None:
        """Take up a checkpoint if there is one."""
        state, reading = checkpoint.read(self.checkpoint, self.identity), self.spent
        if state is not None:
            self.restore(state)
            self.spent += reading
        if parallel.agreed(self.step) != self.step:
            raise MiNtfError(f"{self.checkpoint} is at step {self.step} for this process and at another for the first; "
                             "put it where all processes see it, or delete it")

    def affordable(self) -> float:
        """Pixels of a split that there is time to look at, of both splits twice each."""
        return math.inf if self.minutes == math.inf else max(SCORED, self.speed * 60 * self.minutes * SCORING / 10)

    def finish(self) -> dict:
        """Write the field, read it back, measure it, and store the report in its header."""
        tensors = networks.to_tensors(self.nets)
        report = {k: v for k, v in self.identity.items() if k not in ("config", "field", "data", "estimate")}
        if self.given is not None:
            report["field"] = self.given
        report["bounces"] = self.bounced is not None
        report |= {"steps_done": self.step, "seconds": round(self.spent, 1), "history": self.history,
                   "kept": self.kept, "faults": self.faults}
        header = Header(self.config.architecture, self.similarity, report)
        field_file.save(self.out, header, tensors)
        stored = networks.from_tensors(self.config.architecture, field_file.load(self.out)[1])
        occupancy = scoring.occupied(stored)
        with Display(parallel.first(), "score") as display:
            for i, name in enumerate(("val", "test")):
                scores = scoring.score(stored, occupancy, self.photographs[name], self.config.step, self.light,
                                        self.affordable(), tell=lambda done, i=i: display.update((i + done) / 2))
                scores.pop("each")
                report[name] = {k: round(v, 3 if k != "alpha_rmse" else 5) for k, v in scores.items()}
        report["transmittance"] = held_out.score(stored, occupancy, self.photographs["val"])
        agreement = photographs(self, stored, occupancy, report, self.affordable())
        field_file.save(self.out, Header(self.config.architecture, self.similarity, report), tensors)
        publish(self, stored, occupancy, agreement, report, self.trace, self.out)
        checkpoint.delete(self.checkpoint)
        return report


class _Run(_Loop, Fast):
    """A run of the project's own recipe."""


class _HierarchicalRun(_Loop, Hierarchical):
    """A run of the paper's recipe."""


def _threads() -> int:
    """Idle cores, 1 or 2. Two threads that wait for each other on a busy machine are five times slower than one; runs
    given in steps take one always, so that their sums have one order."""
    return 2 if (os.cpu_count() or 1) - os.getloadavg()[0] > 1.5 else 1
