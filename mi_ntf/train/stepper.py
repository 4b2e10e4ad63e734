"""One step of training: a batch of photographs' rays, the losses, the optimisers."""

import functools
import math
from pathlib import Path

import torch

from ..core.architecture import MAX_LOG_DENSITY
from ..data.readers import load_dataset
from . import losses, monitor, networks, parallel, rays, render
from .baked import Baked
from .config import TrainConfig
from .marched import Marched
from .occupancy import LOG_EMPTY, Occupancy

REFRESH = 32
"""Steps between two updates of the occupancy grid; the baked density is renewed at every fourth of them."""
FIELD = ("density", "reflectance")
"""Networks that photographs train; the others learn from the field."""


class Stepper:
    """The photographs in `dataset`, the networks, and what a step needs of both. The run lasts `minutes` or `steps`."""

    def __init__(self, dataset: Path, config: TrainConfig, minutes: float | None, steps: int | None, seed: int):
        self.config, self.minutes, self.steps = config, minutes or math.inf, steps or math.inf
        self.splits = load_dataset(dataset, monitor.note if parallel.first() else lambda _: None)
        self.rays = {name: rays.from_split(split, name) for name, split in self.splits.items()}
        self.generator = torch.Generator().manual_seed(seed)
        self.nets = parallel.share(networks.initial(config.architecture, config.log_density, self.generator))
        self.optimizers = {"field": self._optimizer(*FIELD), "ntf": self._optimizer("transmittance")}
        self.occupancy = Occupancy(rays.visual_hull(self.splits["train"], config.cells))
        # Rays that miss the hull have nothing to teach. All others stay for good: matter may grow into any of them.
        _, self.seen = self.occupancy.tighten(self.rays["train"])
        self.baked, self.marched = Baked(config.bake), Marched()
        bright = self.rays["train"].target
        bright = bright[bright[:, 3] > 0.99][:, :3].mean(1)
        self.exposure = 1 / max(float(bright.quantile(0.95)) if 0 < len(bright) else 1.0, 1e-6)
        self.step, self.spent = 0, 0.0
        self.samples_per_ray, self.last_bake = 30.0, 0
        self.rate = 1.0
        """Factor of the learning rates, halved by every fault."""
        self.watch = monitor.Watch()
        self.terms: dict[str, torch.Tensor] = {}
        """The last step's weighted terms of the losses."""
        self.trained = [0, 0]
        """Camera rays and their samples that this process has trained on."""

    def _optimizer(self, *names: str) -> torch.optim.Adam:
        tensors = {k: v for k, v in self.nets.tensors.items() if k.split(".")[0] in names}
        planes = {"params": [v for k, v in tensors.items() if ".planes." in k], "base": self.config.lr_planes}
        layers = {"params": [v for k, v in tensors.items() if ".layers." in k], "base": self.config.lr_layers}
        return torch.optim.Adam([planes, layers], betas=(0.9, 0.99), eps=1e-12, fused=True)

    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        return max(self.step / self.steps, self.spent / (60 * self.minutes))

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
        self.optimizers["field"] = self._optimizer(*FIELD)

    def refresh(self) -> None:
        """Bring the no-gradient copies of the density up to date."""
        done = self.progress() >= self.config.ntf_alone
        if self.step % REFRESH == 0 and not done:
            self.occupancy.update(self.nets, self.generator)
        due = self.step % (4 * REFRESH) == 0 and not (done and self.step > self.last_bake + 8 * REFRESH)
        if due or (self.progress() >= self.config.ntf_from and not hasattr(self.marched, "log_sigma")):
            self.bake()

    def bake(self) -> None:
        self.baked.update(self.nets, self.occupancy)
        if self.progress() >= self.config.ntf_from:
            self.marched.update(self.nets, self.occupancy)
        self.last_bake = self.step

    def batch(self):
        """Random camera rays and their samples, about ``config.samples`` of them: ``(rays, (ray, t))``."""
        count = min(8192, max(256, int(self.config.samples / self.samples_per_ray)))
        batch = self.seen[torch.randint(len(self.seen), (count,), generator=self.generator)]
        samples = self.occupancy.samples(batch, self.config.step, self.generator)
        self.samples_per_ray = 0.9 * self.samples_per_ray + 0.1 * max(1.0, len(samples[0]) / count)
        self.trained[0] += count
        self.trained[1] += len(samples[0])
        return batch, samples

    def field_loss(self, batch: rays.Rays, samples):
        """``(terms, image)``: name → weighted term of the photographs; see :mod:`mi_ntf.train.losses`."""
        c, g = self.config, self.generator
        image = render.render(self.nets, batch, samples, c.step)
        terms = {"colour": losses.color(image.color, batch.target[:, :3], self.exposure),
                 "alpha": c.alpha * (image.alpha - batch.target[:, 3]).square().mean()}
        toward, away = losses.normals(image, batch.d, self.baked)
        terms["normal"], terms["facing"] = c.normal * toward, c.facing * away
        terms["bounds"] = c.empty * torch.relu(image.raw - MAX_LOG_DENSITY).mean()
        terms["even"] = c.even * losses.evenness(self.nets, image, 2048, g)
        matter = image.raw[image.index].clamp(max=MAX_LOG_DENSITY)
        terms["sharp"] = -c.sharp * (image.weight.detach() * matter).sum() / len(batch)
        terms["gloss"] = c.gloss * (image.weight.detach() * image.specular).sum() / len(batch)
        x = self.occupancy.must_be_empty(1536, g)
        if len(x):
            terms["empty"] = c.empty * losses.emptiness(self.nets, x)
        if self.step % 4 == 0:
            terms["smooth"] = 4 * c.smooth * losses.total_variation(self.nets)
        return terms, image

    def ntf_loss(self, image: render.Image, batch: rays.Rays) -> dict[str, torch.Tensor]:
        """Name → weighted term of the transmittance network."""
        c, g = self.config, self.generator
        o, d = losses.training_rays(self.marched, batch, c.ntf_rays, c.augmentation, g)
        terms = {"transmittance": losses.transmittance(self.nets, self.marched, o, d, g)}
        if c.colour_loss:
            near = min(96, len(batch))
            lit = losses.transmittance_color(self.nets, self.marched, image, batch, self.exposure, near)
            terms["lit colour"] = 0.1 * lit
        return terms

    def advance(self) -> float:
        """One optimiser step of whatever the schedule trains now; returns the loss. Raises Fault."""
        c, done = self.config, self.progress()
        alone = done >= c.ntf_alone
        self.refresh()
        total = 0.0
        batch, samples = self.batch()
        if alone:
            with torch.no_grad():
                image = render.render(self.nets, batch, samples, c.step)
            self.terms = {}
        else:
            self.terms, image = self.field_loss(batch, samples)
            # Of all terms these two are positive and of a known size.
            self.watch.check("field", float((self.terms["colour"] + self.terms["alpha"]).detach()), self.step)
            rate = c.lr_end ** (done / c.ntf_alone) * min(1.0, (self.step + 1) / 50)
            total += self._descend("field", _sum(self.terms), rate)
        if done >= c.ntf_from:
            terms = self.ntf_loss(image, batch)
            loss = _sum(terms)
            self.watch.check("ntf", float(loss.detach()), self.step)
            total += self._descend("ntf", loss, c.lr_end ** ((done - c.ntf_from) / (1 - c.ntf_from)))
            self.terms |= terms
        return total

    def _descend(self, name: str, loss: torch.Tensor, rate: float) -> float:
        optimizer = self.optimizers[name]
        value = float(loss.detach())
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        parallel.average_gradients(parameters)
        size = float(torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None]))
        if not (math.isfinite(value) and math.isfinite(size)):
            raise monitor.Fault(f"the {name} loss is {value} and its gradient's length {size} at step {self.step}")
        for group in optimizer.param_groups:
            group["lr"] = group["base"] * rate * self.rate
        optimizer.step()
        return value


def _sum(terms: dict[str, torch.Tensor]) -> torch.Tensor:
    """The sum of `terms`, from the first to the last: its last bit is part of what makes a run reproducible."""
    return functools.reduce(torch.add, terms.values())
