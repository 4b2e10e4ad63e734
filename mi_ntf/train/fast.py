"""One step of training: a batch of photographs' rays, the losses, the optimisers."""

import math
from pathlib import Path

import torch

from ..core.architecture import MAX_LOG_DENSITY, Header
from ..core.errors import MiNtfError
from . import device, losses, offset, rays, volume
from .bounced import SEEN, Bounced
from .config import TrainConfig
from .flash import Flash
from .normal_targets import NormalTargets
from .occupancy import LOG_EMPTY, Occupancy, Spans
from .photometry import Gains, trust
from .recipe import FIELD, Recipe, total
from .scoring import Light
from .transmittance_targets import TransmittanceTargets

ROUNDS = (0.3, 0.45, 0.6, 0.75)
"""Shares of the run at which the light that bounced is found: the skin has formed, and albedo follows at once."""
SPACED = 20.0
"""Seconds of a run for each of these rounds, which take some each: the shortest runs do without."""
ESTIMATES = (0.1, 0.2, 0.3, 0.4, 0.55)
"""Shares of the run at which the flash's place is looked for, if that is not known: the place and the shape that is
learned with it come nearer to the truth in turns."""
NOTICED = 6.0
"""Degrees between flash and lens that are worth a warning: nearer ones, as on cameras, change no reflectance."""
ROOM = 0.02
"""Share of the flash that the room sends back, at the start."""
SURFACE_LEVEL = 3.0
"""ln σ where skins meet the surfaces that photographs show: of `statue`, within 0.001 radii of the mesh (median)."""
REFRESH = 32
"""Steps between two updates of the occupancy grid; the baked density is renewed at every fourth of them."""

NEAR = 96
"""Camera rays a step whose pixels are also lit by the learned transmittance."""


class Fast(Recipe):
    """The recipe of the project's own: planes, an occupancy grid in the visual hull, transmittance after the field."""

    HELD = (*Recipe.HELD, "samples_per_ray", "last_bake", "rounds", "steep", "meeting", "estimates", "notes")
    GRIDS = (("occupancy", ("sigma", "level", "stray")), ("baked", ("slope",)), ("marched", ("log_sigma", "reach")),
             ("bounced", ("table", "light", "open")), ("flash", ("place",)))
    config: TrainConfig

    def __init__(self, dataset: Path, config: TrainConfig, minutes: float | None, steps: int | None, seed: int,
                 reading: dict | None = None, estimate: bool = False):
        super().__init__(dataset, config, minutes, steps, seed, reading)
        if estimate and not self.on_lens:
            raise MiNtfError("--flash-offset estimate: the data set says where its lights are; leave the option out")
        pool = self.photographs["train"]
        self.config = config = config.sharpened(rays.pixel_width(self.splits["train"]))
        if config.gains and not self.splits["train"].calibrated:
            self.gains = Gains(pool)
        self.room = None if self.gains is None else torch.nn.Parameter(torch.full((3,), math.log(ROOM)))
        """What the room sends back of the flash, see :class:`mi_ntf.train.bounced.Bounced`; renderings have no room."""
        self.optimizers = {"field": self._optimizer(*FIELD), "ntf": self._optimizer("transmittance", "visibility")}
        hull = rays.visual_hull(pool, config.cells)
        self.occupancy, self.spans = Occupancy(hull), Spans(hull)
        # Rays that miss the hull have nothing to teach. All others stay for good: matter may grow into any of them.
        pool.look_at(self.spans.points(), Spans.BLOCK * math.sqrt(3) / config.cells)
        self.meeting = 0.5
        """Share of the pixels looked at whose rays meet the hull."""
        self.baked, self.marched = NormalTargets(config.bake), TransmittanceTargets()
        self.samples_per_ray, self.last_bake = 30.0, 0
        self.rounds = 0
        """How often the bounced light was found."""
        self.steep = not self.solid
        """Whether skins were made steeper, or there are none."""
        everyone = list(self.photographs.values())
        self.flash = Flash(everyone, self.solid, self.marched)
        """Where the lights are."""
        self.estimating, self.estimates = estimate, 0
        """Whether the lights' place beside the lenses is to be found, and how often it was."""
        self.lens = self.on_lens and not estimate
        """Whether the lights are at the lenses for good."""
        if config.bounces and self.solid:
            self.bounced = Bounced(self.flash, torch.cat([p.light for p in everyone]), self.room)

    @property
    def light(self) -> Light:
        return Light(self.bounced, self.elsewhere, self.gains is not None)

    @property
    def elsewhere(self) -> Flash | None:
        """The lights, if they are not at the lenses."""
        return None if self.lens else self.flash

    def parameters(self) -> dict[str, torch.Tensor]:
        if self.gains is None or self.room is None:
            return self.nets.tensors
        return self.nets.tensors | {"gains": self.gains.logs, "room": self.room}

    def _optimizer(self, *names: str) -> torch.optim.Adam:
        tensors = {k: v for k, v in self.nets.tensors.items() if k.split(".")[0] in names}
        planes = {"params": [v for k, v in tensors.items() if ".planes." in k], "base": self.config.lr_planes}
        layers = {"params": [v for k, v in tensors.items() if ".layers." in k], "base": self.config.lr_layers}
        groups = [planes, layers]
        if self.gains is not None and names == FIELD:
            groups.append({"params": [self.gains.logs, self.room], "base": self.config.lr_gains})
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=True)

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
        if due or (self.progress() >= self.config.ntf_from and not self.marched.known):
            self.bake()
        if not done and self.rounds < len(ROUNDS) and self.progress() >= ROUNDS[self.rounds]:
            # Runs given in steps are the same whatever the clock says.
            if self.minutes == math.inf or self.spent >= SPACED * (self.rounds + 1):
                self.find_bounced()
        looked = self.solid and (self.estimating or not self.splits["train"].located)
        if looked and not done and self.estimates < len(ESTIMATES) and self.progress() >= ESTIMATES[self.estimates]:
            self.find_flash()

    def find_flash(self) -> None:
        """Find where the flash stands beside the lens, and put it there; or warn if the lens was taken for its place.
        """
        self.estimates += 1
        self.baked.update(self.nets, self.occupancy)
        self.marched.update(self.nets, self.occupancy)
        pool = self.photographs["train"]
        some = self.draw(4 * offset.POINTS, device.generator(7 + self.estimates))
        seen = offset.observe(pool, some, self.baked, self.marched)
        distance = float(pool.origin.norm(dim=1).median())
        found = offset.estimate(seen, self.flash, pool.views, distance)
        if found is None:
            return self.note("the photographs show too little of the same points to tell where the flash stands")
        angle = math.degrees(math.atan2(float(found.norm()), distance))
        lengths = ",".join(f"{v * self.similarity.radius:.4g}" for v in found.tolist())
        if self.estimating:
            self.flash.move(found)
            self.notes = [text for text in self.notes if not text.startswith("the flash is found")]
            self.note(f"the flash is found {angle:.1f} degrees off the lens: --flash-offset {lengths}")
        elif angle > NOTICED and self.estimates == len(ESTIMATES):
            self.note(f"warning: the photographs look like those of a flash {angle:.0f} degrees off the lens, which is "
                      f"taken for its place; give --flash-offset {lengths} or --flash-offset estimate")

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
            some = self.draw(SEEN, device.generator(self.rounds))
            self.bounced.update(self.nets, self.marched, some, self.rounds)
        self.rounds += 1

    def bake(self) -> None:
        self.baked.update(self.nets, self.occupancy)
        if self.progress() >= (self.config.ntf_from if self.lens else self.config.shadows_from):
            self.marched.update(self.nets, self.occupancy)
        self.last_bake = self.step

    def draw(self, count: int, generator: torch.Generator) -> rays.Rays:
        """About `count` random camera rays that meet the visual hull, and where they do."""
        pool = self.photographs["train"]
        looked = pool[pool.random(int(count / self.meeting) + 16, generator)]
        _, found = self.spans(looked)
        self.meeting = max(0.9 * self.meeting + 0.1 * len(found) / len(looked), 0.01)
        return found[slice(count)]

    def batch(self):
        """Random camera rays and their samples, about ``config.samples`` of them: ``(rays, (ray, t, width))``."""
        batch = self.draw(min(8192, max(256, int(self.config.samples / self.samples_per_ray))), self.generator)
        count = len(batch)
        cells = self.occupancy.visible(batch, self.config.step, self.generator)
        samples = volume.unspent(self.nets, batch, cells, self.config.step, self.generator)
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
        image = volume.render(self.nets, batch, samples, self.bounced, g, self.progress() >= c.lobes_from,
                              self.elsewhere)
        pool, target = self.photographs["train"], batch.target
        color = image.color if self.gains is None else image.color * self.gains(batch.view)
        trusted = trust(color, target) if pool.levels else 1.0
        known = 1.0 if pool.masked else ((target[:, 3] == 0) | (target[:, 3] == 1)).float()
        terms = {"colour": losses.color(color, target[:, :3], self.exposure, trusted),
                 "alpha": c.alpha * (known * (image.alpha - target[:, 3]).square()).mean()}
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

    def ntf_loss(self, image: volume.Image, batch: rays.Rays) -> dict[str, torch.Tensor]:
        """Name → weighted term of the networks that learn transmittance."""
        c, g = self.config, self.generator
        o, d = losses.training_rays(self.marched, batch, c.ntf_rays, c.augmentation, g)
        targets = losses.targets(self.marched, o, d, g)
        terms = {"transmittance": losses.transmittance(self.nets, targets)}
        if c.architecture.visibility is not None:
            terms["visibility"] = losses.visibility(self.nets, targets)
        if c.colour_loss and self.lens:  # its light comes by the camera's own rays, which the image knows
            near = min(NEAR, len(batch))
            gain = 1.0 if self.gains is None else self.gains(batch.view[:near]).detach()
            lit = losses.transmittance_color(self.nets, self.marched, image, batch, self.exposure, near, gain)
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
                image = volume.render(self.nets, batch[slice(NEAR)], tuple(part[few] for part in samples), self.bounced,
                                      self.generator, flash=self.elsewhere)
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
