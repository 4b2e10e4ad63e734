"""The recipe ``fast``: planes, an occupancy grid in the visual hull, transmittance after the field."""

import math
from dataclasses import asdict, dataclass

import torch

from ..core.architecture import MAX_LOG_DENSITY, RETRO, TAIL
from ..core.errors import MiNtfError
from ..core.progress import Stage
from . import device, losses, networks, offset, parallel, rays, volume
from .bounced import CAMERA_RAYS, Bounced
from .checkpoint import State
from .config import FastConfig
from .finished import FinishedField
from .flash import Flash
from .networks import Tensors
from .normal_targets import NormalTargets
from .occupancy import FULL_BELOW, HAZE, LOG_EMPTY, Occupancy, Spans
from .photometry import Gains, trust
from .recipe import FIELD, Run, Snapshot, copy_into, total
from .scoring import Light
from .transmittance_targets import TransmittanceTargets

BOUNCE_TIMES = (0.3, 0.45, 0.6, 0.75)
"""Times, as fractions of the run, at which bounced light is computed: the skin has formed, and albedo follows."""
BOUNCE_SHARE = 0.2
"""Largest fraction of a run in minutes that its rounds of bounced light may take."""
BOUNCE_COST = 2.0
"""Expected time of the first round, relative to that of shaping the visual hull; later ones take that of the last."""
HULL_SHARE = 0.2
"""Largest fraction of a run in minutes in which the visual hull is shaped."""
ESTIMATE_TIMES = (0.1, 0.2, 0.3, 0.4, 0.55)
"""Times at which the position of the flash is estimated, if it is unknown. Position and shape improve in turns."""
NOTICED = 6.0
"""Angle between flash and lens, degrees, that is worth a warning; smaller ones change no reflectance."""
ROOM = 0.02
"""Light that the room reflects, relative to the flash, at the start."""
SURFACE_LEVEL = 3.0
"""ln σ where skins meet the surfaces that photographs show."""
REFRESH = 32
"""Steps between two updates of the occupancy grid; every fourth of them renews the baked density."""
NEAR = 96
"""Camera rays a step whose pixels are also lit by the learned transmittance."""


@dataclass
class Course:
    """Progress of the schedule and running averages; part of checkpoints."""

    steep: bool  # True if skins have been made steeper, or there are none
    rounds: int = 0  # Number of times that bounced light was computed
    estimates: int = 0  # Number of times that the position of the flash was estimated
    last_bake: int = 0  # Step of the last bake
    samples_per_ray: float = 30.0
    meeting: float = 0.5  # Fraction of the sampled pixels whose rays meet the hull
    bounce: float = 0.0  # Time that a round of bounced light takes, as a fraction of the run; 0 in runs given in steps
    bounced: float = 0.0  # Time that all rounds so far have taken, as a fraction of the run


class Fast:
    """The recipe ``fast``; with `estimate` it searches the position of the flash beside the lens.

    `finished` is a field of the same data to begin with.
    """

    def __init__(self, config: FastConfig, run: Run, estimate: bool = False,
                 finished: FinishedField | None = None):
        skins = run.data.solid and config.architecture.phase is None  # smoke has none, however dense it is
        if estimate and config.architecture.phase is not None:
            raise MiNtfError("--flash-offset estimate reads the shading of surfaces, which smoke has not; give --smoke "
                             "the place of its flash")
        if estimate and not run.data.on_lens:
            raise MiNtfError("--flash-offset estimate: the data set says where its lights are; leave the option out")
        self.run, self.data, self.clock, self.learner = run, run.data, run.clock, run.learner
        self.generator = run.generator
        self.config = config = config.sharpened(self.data.pixel_width)
        self.field_until = config.ntf_alone
        self.networks = parallel.distributed(networks.initial(config.architecture, config.log_density, self.generator))
        pool = self.data.train
        self.gains = Gains(pool) if config.gains and not self.data.splits["train"].calibrated else None
        self.room = None if self.gains is None else torch.nn.Parameter(torch.full((3,), math.log(ROOM)))
        """Light that the room reflects, see :class:`mi_ntf.train.bounced.Bounced`; renderings have no room."""
        self.learner.optimizers = {"field": self._optimizer(*FIELD),
                                   "ntf": self._optimizer("transmittance", "visibility")}
        hull = rays.visual_hull(pool, config.cells)
        self.occupancy = Occupancy(hull, FULL_BELOW if config.architecture.phase is None else HAZE)
        self.spans = Spans(hull)
        # Rays that miss the hull have nothing to teach. All others stay for good: matter may grow into any of them.
        pool.look_at(self.spans.points(), Spans.BLOCK * math.sqrt(3) / config.cells)
        self.baked, self.marched = NormalTargets(config.bake), TransmittanceTargets()
        self.flash = Flash(self.data.all, skins, self.marched)
        self.estimating = estimate
        self.at_lens = self.data.on_lens and not estimate  # True if the lights are at the lenses for the whole run
        self.bounced: Bounced | None = None
        if config.bounces and skins:
            self.bounced = Bounced(self.flash, torch.cat([p.light for p in self.data.all]), self.room)
        self.course = Course(steep=not skins)
        if finished is not None:
            self._take(finished)

    def _optimizer(self, *names: str) -> torch.optim.Adam:
        tensors = {k: v for k, v in self.networks.tensors.items() if k.split(".")[0] in names}
        planes = {"params": [v for k, v in tensors.items() if ".planes." in k], "base": self.config.lr_planes}
        layers = {"params": [v for k, v in tensors.items() if ".layers." in k], "base": self.config.lr_layers}
        numbers = [v for k, v in tensors.items() if k in (RETRO, TAIL)]
        if self.gains is not None and names == FIELD:
            numbers += [v for v in (self.gains.logs, self.room) if v is not None]
        single = {"params": numbers, "base": self.config.lr_gains}
        return torch.optim.Adam([planes, layers, single], betas=(0.9, 0.99), eps=1e-12, fused=True)

    def _take(self, finished: FinishedField) -> None:
        """Take density and reflectance of a finished field; for further training, all that it has learned."""
        tensors = {k: v for k, v in finished.tensors.items()
                if k.split(".")[0] in FIELD or (finished.further and k in self.networks.tensors
                                                and v.shape == self.networks.tensors[k].shape)}
        copy_into(self.networks.tensors, {k: torch.as_tensor(v) for k, v in tensors.items()})
        for _ in range(11):  # skins fill a fraction of their cells
            self.occupancy.sample(self.networks, self.generator)
        self.occupancy.update(self.networks, self.generator)
        if finished.further:
            self.course.steep = True
            self.course.estimates = sum(time <= self.clock.begin for time in ESTIMATE_TIMES)
            learned = finished.header.provenance.get("photographs", {})
            names = [str(name) for name in self.data.train.names or range(self.data.train.views)]
            if self.gains is not None and set(names) <= set(learned.get("gains", {})):
                self.gains.resume(torch.tensor([learned["gains"][name] for name in names]))
            if self.room is not None and "room" in learned:
                self.room.data = torch.tensor(learned["room"]).log()
            if self.estimating:
                self.estimate_flash()
        self.update_bounced()
        self.bake()

    @property
    def elsewhere(self) -> Flash | None:
        """Lights, if they are not at the lenses."""
        return None if self.at_lens else self.flash

    @property
    def light(self) -> Light:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        return Light(self.bounced, self.elsewhere, self.gains is not None)

    def occupied(self) -> Occupancy:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        return self.occupancy

    def parameters(self) -> Tensors:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        if self.gains is None or self.room is None:
            return self.networks.tensors
        return self.networks.tensors | {"gains": self.gains.logs, "room": self.room}

    def snapshot(self) -> Snapshot:
        """Return a copy of the field, without its transmittance, which is yet to learn from it."""
        field = {k: v.detach().clone() for k, v in self.networks.tensors.items() if k.split(".")[0] in FIELD}
        return {"field": field, "occupancy": {k: v.clone() for k, v in self.occupancy.state().items()}}

    def adopt(self, snapshot: Snapshot) -> None:
        """Go back to a :meth:`snapshot`."""
        copy_into(self.networks.tensors, snapshot["field"])
        self.occupancy.restore(snapshot["occupancy"])
        self.bake()

    def state(self) -> State:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        return {"course": asdict(self.course), "occupancy": self.occupancy.state(), "slope": self.baked.slope,
                "log_sigma": self.marched.log_sigma, "reach": self.marched.reach, "place": self.flash.place,
                "bounced": None if self.bounced is None else self.bounced.state()}

    def restore(self, state: State) -> None:
        """Restore a :meth:`state`."""
        self.course = Course(**state["course"])
        self.occupancy.restore(state["occupancy"])
        self.baked.slope, self.flash.place = state["slope"], state["place"]
        self.marched.log_sigma, self.marched.reach = state["log_sigma"], state["reach"]
        if self.bounced is not None:
            self.bounced.restore(state["bounced"])

    def carve(self, steps: int = 300, points: int = 4096) -> None:
        """Give the density the shape of the visual hull, by regression of ln σ: seconds that save minutes."""
        occupancy, generator = self.occupancy, self.generator
        self.clock.count()
        before = self.clock.progress
        for step in range(steps):
            self.clock.count()
            if self.clock.timed and self.clock.progress - before > HULL_SHARE:
                break
            inside = occupancy.index[torch.randint(len(occupancy.index), (points,), generator=generator)]
            x = torch.cat([occupancy.positions(inside, generator), occupancy.must_be_empty(points, generator)])
            raw = self.networks.log_density(x)
            target = torch.full_like(raw, self.config.log_density)
            target[points:] = LOG_EMPTY - 2
            self.learner.descend("field", (raw - target).square().mean(), 1 - 0.9 * step / steps)
        self.learner.optimizers["field"] = self._optimizer(*FIELD)
        self.clock.count()
        self.course.bounce = BOUNCE_COST * (self.clock.progress - before)

    def refresh(self) -> None:
        """Bring all that is computed from the density without gradients up to date."""
        progress, course = self.clock.progress, self.course
        finished = progress >= self.field_until
        if self.clock.step % REFRESH == 0 and not finished:
            self.occupancy.update(self.networks, self.generator)
        if not course.steep and not finished and progress >= self.config.steepen_at:
            self.make_steep()
        due = self.clock.step % (4 * REFRESH) == 0
        due &= not (finished and self.clock.step > course.last_bake + 8 * REFRESH)
        if due or (progress >= self.config.ntf_from and not self.marched.known):
            self.bake()
        if not finished or (self.estimating and not course.estimates):
            self.find_light()

    def find_light(self) -> None:
        """Estimate the position of the flash and compute bounced light, where one is due and there is time.

        In a slow run several rounds may be due at once. The last of them stands for all.
        """
        course, clock = self.course, self.clock
        due = sum(time <= clock.progress for time in ESTIMATE_TIMES)
        unknown = self.flash.solid and (self.estimating or not self.data.splits["train"].located)
        if unknown and course.estimates < due:
            course.estimates = due - 1
            with Stage("estimating the flash", inner=True):
                self.estimate_flash()
            clock.count()
        due = sum(time <= clock.progress for time in BOUNCE_TIMES)
        before = clock.progress
        # Runs given in steps do not depend on the time that they take.
        affordable = not clock.timed or (course.bounced + course.bounce < BOUNCE_SHARE
                                         and before + course.bounce < self.field_until)
        if course.rounds < due and affordable:
            course.rounds = due - 1
            self.update_bounced()
            clock.count()
            if clock.timed:
                course.bounce = clock.progress - before
                course.bounced += course.bounce

    def estimate_flash(self) -> None:
        """Estimate the position of the flash relative to the lens. Use it, or warn if it is assumed at the lens."""
        self.course.estimates += 1
        self.baked.update(self.networks, self.occupancy)
        self.marched.update(self.networks, self.occupancy)
        pool, notes = self.data.train, self.run.notes
        sampled = self.sample_rays(4 * offset.POINTS, device.generator(7 + self.course.estimates))
        observed = offset.observe(pool, sampled, self.baked, self.marched)
        distance = float(pool.origin.norm(dim=1).median())
        place = offset.estimate(observed, self.flash, pool.views, distance)
        if place is None:
            return notes.add("the photographs show too little of the same points to tell where the flash stands")
        angle = math.degrees(math.atan2(float(place.norm()), distance))
        lengths = ",".join(f"{v * self.data.similarity.radius:.4g}" for v in place.tolist())
        if self.estimating:
            self.flash.move(place)
            notes.texts = [text for text in notes.texts if not text.startswith("the flash is found")]
            notes.add(f"the flash is found {angle:.1f} degrees off the lens: --flash-offset {lengths}")
        elif angle > NOTICED and self.course.estimates == len(ESTIMATE_TIMES):
            notes.add(f"warning: the photographs look like those of a flash {angle:.0f} degrees off the lens, which is "
                      f"taken for its place; give --flash-offset {lengths} or --flash-offset estimate")

    @torch.no_grad()
    def make_steep(self) -> None:
        """Multiply the slopes of ln σ around SURFACE_LEVEL, where it does not change."""
        layer = f"density.layers.{len(self.config.architecture.density.hidden)}"
        self.networks.tensors[f"{layer}.weight"] *= self.config.steepen
        bias = self.networks.tensors[f"{layer}.bias"]
        bias += (self.config.steepen - 1) * (bias - SURFACE_LEVEL)
        self.learner.optimizers["field"] = self._optimizer(*FIELD)  # the old moments belong to other slopes
        self.course.steep = True

    def update_bounced(self) -> None:
        """Bring the bounced light up to date."""
        if self.bounced is not None:
            with Stage("computing bounced light", inner=True):
                self.marched.update(self.networks, self.occupancy)
                sampled = self.sample_rays(CAMERA_RAYS, device.generator(self.course.rounds))
                self.bounced.update(self.networks, self.marched, sampled, self.course.rounds)
        self.course.rounds += 1

    def bake(self) -> None:
        """Bring the baked densities up to date."""
        with Stage("baking", inner=True):
            self.baked.update(self.networks, self.occupancy)
            if self.clock.progress >= (self.config.ntf_from if self.at_lens else self.config.shadows_from):
                self.marched.update(self.networks, self.occupancy)
        self.course.last_bake = self.clock.step

    def sample_rays(self, count: int, generator: torch.Generator) -> rays.Rays:
        """Return about `count` random camera rays that meet the visual hull, with the pieces that do."""
        pool = self.data.train
        candidates = pool[pool.random(int(count / self.course.meeting) + 16, generator)]
        _, meeting = self.spans(candidates)
        self.course.meeting = max(0.9 * self.course.meeting + 0.1 * len(meeting) / len(candidates), 0.01)
        return meeting[slice(count)]

    def batch(self) -> tuple[rays.Rays, volume.Samples]:
        """Return random camera rays and their samples, about ``config.samples`` of them."""
        course, step = self.course, self.config.step
        batch = self.sample_rays(min(8192, max(256, int(self.config.samples / course.samples_per_ray))), self.generator)
        cells = self.occupancy.visible(batch, step, self.generator)
        samples = volume.unspent(self.networks, batch, cells, step, self.generator)
        course.samples_per_ray = 0.9 * course.samples_per_ray + 0.1 * max(1.0, len(samples.ray) / len(batch))
        self.learner.rays += len(batch)
        self.learner.samples += len(samples.ray)
        return batch, samples

    @property
    def fading(self) -> float:
        """Factor of the field's learning rates and of the cost of sharp lobes, from 1 to ``config.lr_end``.

        The cost says what is glossy at all; how much so, photographs alone should say.
        """
        return float(self.config.lr_end ** (self.clock.progress / self.field_until))

    def field_loss(self, batch: rays.Rays, samples: volume.Samples) -> tuple[Tensors, volume.Image]:
        """Return the weighted loss terms of the photographs by name, and the rendered image."""
        c, g, nets = self.config, self.generator, self.networks
        image = volume.render(nets, batch, samples, self.bounced, g, self.clock.progress >= c.lobes_from,
                              self.elsewhere)
        pool, target = self.data.train, batch.target
        color = image.color if self.gains is None else image.color * self.gains(batch.view)
        weight = trust(color, target) if pool.quantized else 1.0
        known = 1.0 if pool.masked else ((target[:, 3] == 0) | (target[:, 3] == 1)).float()
        terms = {"colour": losses.color(color, target[:, :3], self.data.exposure, weight),
                 "alpha": c.alpha * (known * (image.alpha - target[:, 3]).square()).mean()}
        terms["bounds"] = c.empty * torch.relu(image.raw - MAX_LOG_DENSITY).mean()
        terms["even"] = c.even * losses.evenness(nets, image, c.even_over, 2048, g)
        if nets.phase is None:
            terms |= self.surface_loss(image, batch)
        x = self.occupancy.must_be_empty(1536, g)
        if len(x):
            terms["empty"] = c.empty * losses.emptiness(nets, x)
        if self.clock.step % 4 == 0:
            smooth = c.smooth if nets.phase is None else c.smooth_smoke
            terms["smooth"] = 4 * smooth * losses.total_variation(nets)
        return terms, image

    def surface_loss(self, image: volume.Image, batch: rays.Rays) -> Tensors:
        """Return the weighted loss terms of normals, skins and specular lobes, which smoke does not have."""
        c = self.config
        error, backward = losses.normals(image, batch.d, self.baked)
        matter = image.raw[image.index].clamp(max=MAX_LOG_DENSITY)
        return {
            "normal": c.normal * error, "facing": c.facing * backward,
            "sharp": -c.sharp * self.data.opaque * (image.weight.detach() * matter).sum() / len(batch),
            "gloss": c.gloss * losses.gloss(image, c.architecture.least_specular, self.fading, len(batch)),
        }

    def ntf_loss(self, image: volume.Image, batch: rays.Rays) -> Tensors:
        """Return the weighted loss terms of the networks that learn transmittance, by name."""
        c, g = self.config, self.generator
        o, d = losses.training_rays(self.marched, batch, c.ntf_rays, c.augmentation, g)
        targets = losses.targets(self.marched, o, d, g)
        terms = {"transmittance": losses.transmittance(self.networks, targets)}
        if c.architecture.visibility is not None:
            terms["visibility"] = losses.visibility(self.networks, targets)
        if c.colour_loss and self.at_lens:  # light comes along the camera's rays, which the image knows
            near = min(NEAR, len(batch))
            gain = 1.0 if self.gains is None else self.gains(batch.view[:near]).detach()
            terms["lit colour"] = 0.1 * losses.transmittance_color(self.networks, self.marched, image, batch,
                                                                   self.data.exposure, near, gain)
        return terms

    def advance(self) -> float:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        c, progress, learner = self.config, self.clock.progress, self.learner
        self.refresh()
        value = 0.0
        batch, samples = self.batch()
        if progress >= self.field_until:
            few = samples.ray < NEAR
            with torch.no_grad():
                image = volume.render(self.networks, batch[slice(NEAR)],
                                      volume.Samples(*(part[few] for part in samples)), self.bounced, self.generator,
                                      flash=self.elsewhere)
            learner.terms = {}
        else:
            learner.terms, image = self.field_loss(batch, samples)
            learner.check("field", learner.terms["colour"] + learner.terms["alpha"])
            rate = self.fading * min(1.0, (self.clock.step - self.clock.first + 1) / 50)
            value += learner.descend("field", total(learner.terms), rate)
        if progress >= c.ntf_from:
            terms = self.ntf_loss(image, batch)
            loss = total(terms)
            learner.check("ntf", loss)
            value += learner.descend("ntf", loss, c.lr_end ** ((progress - c.ntf_from) / (1 - c.ntf_from)))
            learner.terms |= terms
        return value
