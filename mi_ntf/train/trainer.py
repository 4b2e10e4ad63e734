"""The training loop: photographs in, one field file out."""

import dataclasses
import json
import math
import os
import resource
import time
from pathlib import Path

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ..core import field_file
from ..core.architecture import MAX_LOG_DENSITY, Header, Similarity
from ..core.errors import MiNtfError
from ..data.schema import load_split
from . import evaluate, losses, networks, rays, render
from .baked import Baked
from .config import PRESETS, TrainConfig
from .occupancy import LOG_EMPTY, Occupancy

REFRESH = 32
"""Steps between two updates of the occupancy grid; the baked density is renewed at every fourth of them."""


def train(dataset: Path, out: Path, *, preset: str = "fast", minutes: float | None = None, steps: int | None = None,
          seed: int = 0) -> dict:
    """Train a field on the photographs in `dataset` and write it to `out`. Returns the report (JSON types).

    The run lasts `minutes` (10 unless told) or `steps`; runs given in steps are reproducible, bit for bit on one
    machine. A checkpoint ``OUT.ckpt`` is written every minute, taken up by the same command, deleted at the end.
    """
    if preset not in PRESETS:
        raise MiNtfError(f"preset '{preset}' is unknown; it is one of {', '.join(PRESETS)}")
    if minutes is not None and steps is not None:
        raise MiNtfError(f"both --minutes {minutes:g} and --steps {steps} are given; a run is limited by one of them")
    limit = steps if steps is not None else 10.0 if minutes is None else minutes
    if not (limit > 0 and math.isfinite(limit)):
        raise MiNtfError(f"--{'minutes' if steps is None else 'steps'} is {limit:g}; it must be positive")
    torch.set_num_threads(_threads() if steps is None else 1)
    run = _Run(Path(dataset), Path(out), PRESETS[preset], preset, minutes=None if steps is not None else float(limit),
               steps=steps, seed=seed)
    run.resume()
    if not run.step:
        run.carve()
    run.loop()
    return run.finish()


class _Run:
    """State of one training run."""

    def __init__(self, dataset: Path, out: Path, config: TrainConfig, preset: str, *, minutes, steps, seed):
        self.config, self.out, self.checkpoint = config, out, Path(f"{out}.ckpt")
        self.minutes, self.steps = minutes, steps
        self.splits = {name: load_split(dataset, name) for name in ("train", "val", "test")}
        self.rays = {name: rays.from_split(split, name) for name, split in self.splits.items()}
        self.identity = json.dumps({"preset": preset, "minutes": minutes, "steps": steps, "seed": seed,
                                    "config": dataclasses.asdict(config),
                                    "views": {k: len(s.images) for k, s in self.splits.items()}}, sort_keys=True)
        self.generator = torch.Generator().manual_seed(seed)
        self.nets = networks.initial(config.architecture, config.log_density, self.generator)
        self.optimizers = {"field": self._optimizer("density", "reflectance"), "ntf": self._optimizer("transmittance")}
        self.occupancy = Occupancy(rays.visual_hull(self.splits["train"], config.cells))
        # Rays that miss the hull have nothing to teach. All others stay for good: matter may grow into any of them.
        _, self.seen = self.occupancy.tighten(self.rays["train"])
        self.baked = Baked(config.bake)
        bright = self.rays["train"].target
        bright = bright[bright[:, 3] > 0.99][:, :3].mean(1)
        self.exposure = 1 / max(float(bright.quantile(0.95)) if 0 < len(bright) else 1.0, 1e-6)
        self.step, self.spent = 0, 0.0
        self.history: list[dict] = []
        self.samples_per_ray, self.last_bake = 30.0, 0

    def _optimizer(self, *names: str) -> torch.optim.Adam:
        tensors = {k: v for k, v in self.nets.tensors.items() if k.split(".")[0] in names}
        planes = {"params": [v for k, v in tensors.items() if ".planes." in k], "base": self.config.lr_planes}
        layers = {"params": [v for k, v in tensors.items() if ".layers." in k], "base": self.config.lr_layers}
        return torch.optim.Adam([planes, layers], betas=(0.9, 0.99), eps=1e-12, fused=True)

    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        return self.step / self.steps if self.steps else self.spent / (60 * self.minutes)

    def carve(self, steps: int = 300, points: int = 4096) -> None:
        """Give the density the shape of the visual hull, ln σ by regression: seconds that save minutes."""
        occupancy, generator = self.occupancy, self.generator
        for step in range(steps):
            inside = occupancy.index[torch.randint(len(occupancy.index), (points,), generator=generator)]
            x = torch.cat([occupancy.positions(inside, generator), occupancy.must_be_empty(points, generator)])
            raw = self.nets.log_density(x)
            wanted = torch.full_like(raw, self.config.log_density)
            wanted[points:] = LOG_EMPTY - 2
            self._descend("field", (raw - wanted).square().mean(), 1 - 0.9 * step / steps)
        self.optimizers["field"] = self._optimizer("density", "reflectance")

    # --- one step -------------------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Bring the no-gradient copies of the density up to date."""
        done = self.progress() >= self.config.ntf_alone
        if self.step % REFRESH == 0 and not done:
            self.occupancy.update(self.nets, self.generator)
        if self.step % (4 * REFRESH) == 0 and not (done and self.step > self.last_bake + 8 * REFRESH):
            self.baked.update(self.nets, self.occupancy)
            self.last_bake = self.step

    def batch(self):
        """Random camera rays and their samples, about ``config.samples`` of them: ``(rays, (ray, t))``."""
        count = min(8192, max(256, int(self.config.samples / self.samples_per_ray)))
        batch = self.seen[torch.randint(len(self.seen), (count,), generator=self.generator)]
        samples = self.occupancy.samples(batch, self.config.step, self.generator)
        self.samples_per_ray = 0.9 * self.samples_per_ray + 0.1 * max(1.0, len(samples[0]) / count)
        return batch, samples

    def field_loss(self, batch: rays.Rays, samples):
        """``(loss, image)`` of the photographs; see :mod:`mi_ntf.train.losses`."""
        c, g = self.config, self.generator
        image = render.render(self.nets, batch, samples, c.step)
        loss = losses.color(image.color, batch.target[:, :3], self.exposure)
        loss = loss + c.alpha * (image.alpha - batch.target[:, 3]).square().mean()
        toward, away = losses.normals(image, batch.d, self.baked)
        loss = loss + c.normal * toward + c.facing * away
        loss = loss + c.empty * torch.relu(image.raw - MAX_LOG_DENSITY).mean()
        loss = loss + c.even * losses.evenness(self.nets, image, 2048, g)
        matter = image.raw[image.index].clamp(max=MAX_LOG_DENSITY)
        loss = loss - c.sharp * (image.weight.detach() * matter).sum() / len(batch)
        x = self.occupancy.must_be_empty(1536, g)
        if len(x):
            loss = loss + c.empty * losses.emptiness(self.nets, x)
        if self.step % 4 == 0:
            loss = loss + 4 * c.smooth * losses.total_variation(self.nets)
        return loss, image

    def advance(self) -> float:
        """One optimiser step of whatever the schedule trains now; returns the loss."""
        c, done = self.config, self.progress()
        self.refresh()
        total = 0.0
        alone = done >= c.ntf_alone
        batch, samples = self.batch()
        if alone:
            with torch.no_grad():
                image = render.render(self.nets, batch, samples, c.step)
        else:
            loss, image = self.field_loss(batch, samples)
            total += self._descend("field", loss, c.lr_end ** (done / c.ntf_alone) * min(1.0, (self.step + 1) / 50))
        if done >= c.ntf_from:
            surface = image.x[image.weight > 0.05].detach()
            count = c.ntf_rays * (3 if alone else 1)
            loss = losses.transmittance(self.nets, self.baked, surface, count, self.generator)
            loss = loss + 0.1 * losses.transmittance_color(self.nets, image, batch, self.exposure, min(512, len(batch)))
            total += self._descend("ntf", loss, c.lr_end ** ((done - c.ntf_from) / (1 - c.ntf_from)))
        return total

    def _descend(self, name: str, loss: torch.Tensor, rate: float) -> float:
        optimizer = self.optimizers[name]
        value = float(loss.detach())
        if not math.isfinite(value):
            raise MiNtfError(f"training diverged: the {name} loss is {value} at step {self.step}; nothing was written "
                             f"to {self.out}. Try another --seed; if it persists, check the light intensities")
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for group in optimizer.param_groups:
            group["lr"] = group["base"] * rate
        optimizer.step()
        return value

    # --- the loop -------------------------------------------------------------------------------------------------

    def loop(self) -> None:
        """Step until the limit; show progress, validate, save checkpoints."""
        columns = (TextColumn("train"), BarColumn(), TextColumn("{task.percentage:3.0f}%"),
                   TextColumn("step {task.fields[step]}  loss {task.fields[loss]:.4f}  val {task.fields[psnr]:.2f} dB  "
                              "{task.fields[memory]:.1f} GiB"), TimeRemainingColumn())
        with Progress(*columns, transient=False) as display:
            task = display.add_task("train", total=1.0, step=0, loss=0.0, psnr=float("nan"), memory=0.0)
            saved = time.monotonic()
            validated, average = self.progress(), None
            while self.progress() < 1:
                start = time.monotonic()
                value = self.advance()
                self.step += 1
                self.spent += time.monotonic() - start
                average = value if average is None else 0.98 * average + 0.02 * value
                if self.step % 20 == 0:
                    display.update(task, completed=self.progress(), step=self.step, loss=average, memory=_memory())
                if self.progress() - validated > 0.1 and self.progress() < self.config.ntf_alone:
                    validated = self.progress()
                    start = time.monotonic()
                    self.history.append(self.validate())
                    self.spent += time.monotonic() - start
                    display.update(task, psnr=self.history[-1]["psnr"])
                    display.console.print(f"step {self.step}: {self.history[-1]}", highlight=False)
                if time.monotonic() - saved > 60:
                    self.save()
                    saved = time.monotonic()

    def validate(self) -> dict:
        """PSNR of at most 4 validation views with the current occupancy."""
        split = self.splits["val"]
        count = min(4, len(split.images))
        part = self.rays["val"][slice(0, count * split.images[0, ..., 0].size)]
        generator = torch.Generator().manual_seed(2)
        color, _, _ = evaluate.render_all(self.nets, part, self.occupancy, self.config.step, generator)
        return {"step": self.step, "psnr": round(evaluate.psnr(color, part.target[:, :3], count)["srgb"], 2)}

    # --- files ----------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the checkpoint atomically. It holds all that decides the next step: a resumed run is the same run."""
        held = {"step": self.step, "spent": self.spent, "history": self.history, "last_bake": self.last_bake,
                "samples_per_ray": self.samples_per_ray}
        state = {"identity": self.identity, "held": held, "random": self.generator.get_state(),
                 "tensors": {k: v.detach() for k, v in self.nets.tensors.items()},
                 "optimizers": {k: o.state_dict() for k, o in self.optimizers.items()},
                 "occupancy": {k: getattr(self.occupancy, k) for k in ("sigma", "level", "stray")},
                 "baked": {k: getattr(self.baked, k) for k in ("sigma", "slope", "reach")}}
        temporary = Path(f"{self.checkpoint}.part")
        torch.save(state, temporary)
        os.replace(temporary, self.checkpoint)

    def resume(self) -> None:
        """Take up a checkpoint if there is one."""
        if not self.checkpoint.is_file():
            return
        try:
            state = torch.load(self.checkpoint, weights_only=True)
            identity = state["identity"]
        except Exception as error:
            raise MiNtfError(f"{self.checkpoint} cannot be read ({error}); delete it to start anew") from None
        if identity != self.identity:
            raise MiNtfError(f"{self.checkpoint} belongs to a run with other settings ({identity[:200]}…); repeat that "
                             "command, or delete the file to start anew")
        with torch.no_grad():
            for name, value in state["tensors"].items():
                self.nets.tensors[name].copy_(value)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        for name in ("occupancy", "baked"):
            for key, value in state[name].items():
                setattr(getattr(self, name), key, value)
        for name, value in state["held"].items():
            setattr(self, name, value)
        self.generator.set_state(state["random"])

    def finish(self) -> dict:
        """Write the field, read it back, measure it, and store the report in its header."""
        x, y, z = map(float, self.splits["train"].center)
        similarity = Similarity((x, y, z), float(self.splits["train"].radius))
        tensors = networks.to_tensors(self.nets)
        report = {k: v for k, v in json.loads(self.identity).items() if k != "config"}
        report |= {"steps_done": self.step, "seconds": round(self.spent, 1), "history": self.history}
        header = Header(self.config.architecture, similarity, report)
        field_file.save(self.out, header, tensors)
        stored = networks.from_tensors(self.config.architecture, field_file.load(self.out)[1])
        for name in ("val", "test"):
            scores = evaluate.score(stored, self.rays[name], len(self.splits[name].images), self.config.step)
            report[name] = {k: round(v, 3 if k != "alpha_rmse" else 5) for k, v in scores.items()}
        field_file.save(self.out, Header(self.config.architecture, similarity, report), tensors)
        self.checkpoint.unlink(missing_ok=True)
        return report


def _threads() -> int:
    """Idle cores, 1 or 2. Two threads that wait for each other on a busy machine are five times slower than one; runs
    given in steps take one always, so that their sums have one order."""
    return 2 if (os.cpu_count() or 1) - os.getloadavg()[0] > 1.5 else 1


def _memory() -> float:
    """Largest memory this process has held so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
