"""One step of training: a batch of photographs' rays, the losses, the optimisers."""

import math
from pathlib import Path

import torch

from ..core.architecture import MAX_LOG_DENSITY, Header
from . import losses, rays, render
from .baked import Baked
from .bounced import Bounced
from .config import TrainConfig
from .descent import FIELD, Descent, total
from .marched import Marched
from .occupancy import LOG_EMPTY, Occupancy

ROUNDS = (0.3, 0.45, 0.6, 0.75)
"""Shares of the run at which the light that bounced is found: the skin has formed, and albedo follows at once."""
SPACED = 20.0
"""Seconds of a run for each of these rounds, which take some each: the shortest runs do without."""
SOLID = 0.5
"""Share of the object's pixels that nothing may shine through, or it is smoke, which has no skin, and whose
bounces are others."""
SURFACE_LEVEL = 3.0
"""ln σ where skins meet the surfaces that photographs show: of `statue`, within 0.001 radii of the mesh (median)."""
REFRESH = 32
"""Steps between two updates of the occupancy grid; the baked density is renewed at every fourth of them."""

NEAR = 96
"""Camera rays a step whose pixels are also lit by the learned transmittance."""


class Stepper(Descent):
    """The recipe of the project's own: planes, an occupancy grid in the visual hull, transmittance after the field."""

    HELD = (*Descent.HELD, "samples_per_ray", "last_bake", "rounds", "steep")
    GRIDS = (("occupancy", ("sigma", "level", "stray")), ("baked", ("slope",)), ("marched", ("log_sigma", "reach")),
             ("bounced", ("table", "light")))
    config: TrainConfig

    def __init__(self, dataset: Path, config: TrainConfig, minutes: float | None, steps: int | None, seed: int):
        super().__init__(dataset, config, minutes, steps, seed)
        self.config = config = config.sharpened(rays.pixel_width(self.splits["train"]))
        self.optimizers = {"field": self._optimizer(*FIELD), "ntf": self._optimizer("transmittance", "visibility")}
        self.occupancy = Occupancy(rays.visual_hull(self.splits["train"], config.cells))
        # Rays that miss the hull have nothing to teach. All others stay for good: matter may grow into any of them.
        _, self.seen = self.occupancy.tighten(self.rays["train"])
        self.baked, self.marched = Baked(config.bake), Marched()
        self.samples_per_ray, self.last_bake = 30.0, 0
        self.rounds = 0
        """How often the bounced light was found."""
        solid = self.opaque > SOLID
        self.steep = not solid
        """Whether skins were made steeper, or there are none."""
        if config.bounces and solid:
            flashes = [rays.flashes(split) for split in self.splits.values()]
            self.bounced = Bounced(*(torch.cat(parts) for parts in zip(*flashes, strict=True)))

    def _optimizer(self, *names: str) -> torch.optim.Adam:
        tensors = {k: v for k, v in self.nets.tensors.items() if k.split(".")[0] in names}
        planes = {"params": [v for k, v in tensors.items() if ".planes." in k], "base": self.config.lr_planes}
        layers = {"params": [v for k, v in tensors.items() if ".layers." in k], "base": self.config.lr_layers}
        return torch.optim.Adam([planes, layers], betas=(0.9, 0.99), eps=1e-12, fused=True)

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

    def take(self, path: Path, header: Header, tensors: dict) -> None:
        super().take(path, header, tensors)
        for _ in range(11):  # skins fill a fraction of their cells
            self.occupancy.look(self.nets, self.generator)
        self.occupancy.update(self.nets, self.generator)
        self.find_bounced()

    def occupied(self) -> Occupancy:
        return self.occupancy

    def snapshot(self) -> dict:
        """The field, without its transmittance, which has yet to learn from it."""
        tensors = {k: v for k, v in super().snapshot()["tensors"].items() if k.split(".")[0] in FIELD}
        return {"tensors": tensors, "occupancy": {k: getattr(self.occupancy, k).clone() for k in self.GRIDS[0][1]}}

    def adopt(self, snapshot: dict) -> None:
        super().adopt(snapshot)
        for name, value in snapshot["occupancy"].items():
            setattr(self.occupancy, name, value)
        self.bake()

    def refresh(self) -> None:
        """Bring the no-gradient copies of the density up to date."""
        done = self.progress() >= self.config.ntf_alone
        if self.step % REFRESH == 0 and not done:
            self.occupancy.update(self.nets, self.generator)
        if not self.steep and not done and self.progress() >= self.config.steepen_at:
            self.make_steep()
        due = self.step % (4 * REFRESH) == 0 and not (done and self.step > self.last_bake + 8 * REFRESH)
        if due or (self.progress() >= self.config.ntf_from and not hasattr(self.marched, "log_sigma")):
            self.bake()
        if not done and self.rounds < len(ROUNDS) and self.progress() >= ROUNDS[self.rounds]:
            # Runs given in steps are the same whatever the clock says.
            if self.minutes == math.inf or self.spent >= SPACED * (self.rounds + 1):
                self.find_bounced()

    @torch.no_grad()
    def make_steep(self) -> None:
        """Multiply the slopes of ln σ, around SURFACE_LEVEL, which stays where it is."""
        layer = f"density.layers.{len(self.config.architecture.density.hidden)}"
        self.nets.tensors[f"{layer}.weight"] *= self.config.steepen
        bias = self.nets.tensors[f"{layer}.bias"]
        bias += (self.config.steepen - 1) * (bias - SURFACE_LEVEL)
        self.optimizers["field"] = self._optimizer(*FIELD)  # the old one's steps are of other slopes
        self.steep = True

    def find_bounced(self) -> None:
        """Bring the light that bounced up to date."""
        if self.bounced is not None:
            self.marched.update(self.nets, self.occupancy)
            self.bounced.update(self.nets, self.marched, self.seen, self.rounds)
        self.rounds += 1

    def bake(self) -> None:
        self.baked.update(self.nets, self.occupancy)
        if self.progress() >= self.config.ntf_from:
            self.marched.update(self.nets, self.occupancy)
        self.last_bake = self.step

    def batch(self):
        """Random camera rays and their samples, about ``config.samples`` of them: ``(rays, (ray, t, width))``."""
        count = min(8192, max(256, int(self.config.samples / self.samples_per_ray)))
        batch = self.seen[torch.randint(len(self.seen), (count,), generator=self.generator)]
        cells = self.occupancy.visible(batch, self.config.step, self.generator)
        samples = render.unspent(self.nets, batch, cells, self.config.step, self.generator)
        self.samples_per_ray = 0.9 * self.samples_per_ray + 0.1 * max(1.0, len(samples[0]) / count)
        self.trained[0] += count
        self.trained[1] += len(samples[0])
        return batch, samples

    def fading(self) -> float:
        """1 at the start, ``config.lr_end`` when the field is finished: of learning rates, and of the cost of sharp
        lobes. It says what is glossy at all; how much so, photographs alone should say."""
        return self.config.lr_end ** (self.progress() / self.config.ntf_alone)

    def field_loss(self, batch: rays.Rays, samples):
        """``(terms, image)``: name → weighted term of the photographs; see :mod:`mi_ntf.train.losses`."""
        c, g = self.config, self.generator
        image = render.render(self.nets, batch, samples, self.bounced, g, self.progress() >= c.lobes_from)
        terms = {"colour": losses.color(image.color, batch.target[:, :3], self.exposure),
                 "alpha": c.alpha * (image.alpha - batch.target[:, 3]).square().mean()}
        toward, away = losses.normals(image, batch.d, self.baked)
        terms["normal"], terms["facing"] = c.normal * toward, c.facing * away
        terms["bounds"] = c.empty * torch.relu(image.raw - MAX_LOG_DENSITY).mean()
        terms["even"] = c.even * losses.evenness(self.nets, image, c.even_over, 2048, g)
        matter = image.raw[image.index].clamp(max=MAX_LOG_DENSITY)
        terms["sharp"] = -c.sharp * self.opaque * (image.weight.detach() * matter).sum() / len(batch)
        terms["gloss"] = c.gloss * losses.gloss(image, c.architecture.least_specular, self.fading(), len(batch))
        x = self.occupancy.must_be_empty(1536, g)
        if len(x):
            terms["empty"] = c.empty * losses.emptiness(self.nets, x)
        if self.step % 4 == 0:
            terms["smooth"] = 4 * c.smooth * losses.total_variation(self.nets)
        return terms, image

    def ntf_loss(self, image: render.Image, batch: rays.Rays) -> dict[str, torch.Tensor]:
        """Name → weighted term of the networks that learn transmittance."""
        c, g = self.config, self.generator
        o, d = losses.training_rays(self.marched, batch, c.ntf_rays, c.augmentation, g)
        targets = losses.targets(self.marched, o, d, g)
        terms = {"transmittance": losses.transmittance(self.nets, targets)}
        if c.architecture.visibility is not None:
            terms["visibility"] = losses.visibility(self.nets, targets)
        if c.colour_loss:
            near = min(NEAR, len(batch))
            lit = losses.transmittance_color(self.nets, self.marched, image, batch, self.exposure, near)
            terms["lit colour"] = 0.1 * lit
        return terms

    def advance(self) -> float:
        """One optimiser step of whatever the schedule trains now; returns the loss. Raises Fault."""
        c, done = self.config, self.progress()
        alone = done >= c.ntf_alone
        self.refresh()
        value = 0.0
        batch, samples = self.batch()
        if alone:
            few = samples[0] < NEAR
            with torch.no_grad():
                image = render.render(self.nets, batch[slice(NEAR)], tuple(part[few] for part in samples), self.bounced,
                                      self.generator)
            self.terms = {}
        else:
            self.terms, image = self.field_loss(batch, samples)
            # Of all terms these two are positive and of a known size.
            self.watch.check("field", float((self.terms["colour"] + self.terms["alpha"]).detach()), self.step)
            rate = self.fading() * min(1.0, (self.step + 1) / 50)
            value += self._descend("field", total(self.terms), rate)
        if done >= c.ntf_from:
            terms = self.ntf_loss(image, batch)
            loss = total(terms)
            self.watch.check("ntf", float(loss.detach()), self.step)
            value += self._descend("ntf", loss, c.lr_end ** ((done - c.ntf_from) / (1 - c.ntf_from)))
            self.terms |= terms
        return value
