"""What every recipe's stepper has: the photographs, the networks, and a guarded step of an optimiser."""

import copy
import functools
import math
import time
from pathlib import Path

import torch

from ..core.architecture import Header, Similarity
from ..core.errors import MiNtfError
from ..data.readers import load_dataset
from . import device, monitor, networks, parallel, rays
from .bounced import Bounced
from .occupancy import Occupancy
from .photometry import Gains
from .scoring import Light

FIELD = ("density", "reflectance")
"""Networks that photographs train; the others learn from the field."""
SOLID = 0.5
"""Share of the object's pixels that nothing may shine through, or it is smoke, which has no skin, and whose
bounces are others."""
SCORING = 0.09
"""Share of the minutes that is left for the scores and the page of the finished field."""
SURVEYED = 1 << 18
"""Pixels that tell how bright the photographs are, and how opaque the object."""


class Recipe:
    """The photographs in `dataset` and networks to train on them. The run lasts `minutes` or `steps`.

    A stepper adds `optimizers` and :meth:`advance`, and names what of it a checkpoint must hold.
    """

    HELD: tuple[str, ...] = ("step", "spent", "rate")
    """Attributes that decide how the run goes on."""
    OWN: tuple[str, ...] = ()
    """Those of the loop around the stepper."""
    GRIDS: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Attributes that hold tensors, and which."""
    optimizers: dict[str, torch.optim.Optimizer]

    def __init__(self, dataset: Path, config, minutes: float | None, steps: int | None, seed: int,
                 reading: dict | None = None):
        self.config, self.minutes, self.steps = config, minutes or math.inf, steps or math.inf
        start = time.monotonic()
        self.notes: list[str] = []
        """What was said of the photographs."""
        self.splits = load_dataset(dataset, self.note, **(reading or {}))
        self.photographs, views = {}, 0
        for name, split in self.splits.items():
            self.photographs[name] = rays.Photographs(split, views)
            views += len(split.images)
        self.generator = device.generator(seed)
        self.nets = parallel.share(networks.initial(config.architecture, config.log_density, self.generator))
        pool = self.photographs["train"]
        some = pool.pixels(torch.randint(len(pool), (min(len(pool), SURVEYED),), generator=device.generator(5)))
        matter = some[some[:, 3] > (0.01 if pool.masked else 0.99)]
        self.opaque = float((matter[:, 3] > 0.99).float().mean()) if len(matter) else 1.0
        """Share of the object's pixels that nothing shines through: 0.9 and more of solid things, 0.01 of a cloud."""
        bright = matter[matter[:, 3] > 0.5][:, :3].mean(1)
        self.exposure = 1 / max(float(bright.quantile(0.95)) if 0 < len(bright) else 1.0, 1e-6)
        x, y, z = map(float, self.splits["train"].center)
        self.similarity = Similarity((x, y, z), float(self.splits["train"].radius))
        self.solid = self.opaque > SOLID
        """Whether the object has a skin."""
        self.on_lens = all(p.on_lens for p in self.photographs.values())
        """Whether all lights are at their lenses, as far as the data set tells."""
        self.gains: Gains | None = None
        """Exposure and white balance of the photographs for training, where nobody measured them."""
        self.bounced: Bounced | None = None
        """Light of the flashes that bounced, of a recipe that counts with it."""
        self.given: dict | None = None
        """How the field was trained that :meth:`take` took."""
        self.step, self.spent = 0, time.monotonic() - start
        self.rate = 1.0
        """Factor of the learning rates, halved by every fault."""
        self.watch = monitor.Watch()
        self.terms: dict[str, torch.Tensor] = {}
        """The last step's weighted terms of the losses."""
        self.trained = [0, 0]
        """Camera rays and their samples that this process has trained on."""

    def note(self, text: str) -> None:
        """Tell the user `text`, once, and keep it for the report."""
        if text not in self.notes:
            self.notes.append(text)
            if parallel.first():
                monitor.note(text)

    @property
    def light(self) -> Light:
        """What lights the photographs."""
        return Light(self.bounced)

    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        return max(self.step / self.steps, self.spent / (60 * self.minutes * (1 - SCORING)))

    def advance(self) -> float:
        """One optimiser step of whatever the recipe trains now; returns the loss. Raises Fault."""
        raise NotImplementedError

    @torch.no_grad()
    def take(self, path: Path, header: Header, tensors: dict) -> None:
        """Take density and reflectance of the field file `path`, which is of this very data set."""
        here, there = ((*s.center, s.radius) for s in (self.similarity, header.similarity))
        if max(abs(a - b) for a, b in zip(here, there, strict=True)) > 1e-4 * self.similarity.radius:
            raise MiNtfError(f"{path} has its unit sphere (centre, radius) at {there}, the data set has it at {here}; "
                             "--field needs the data set that the field was trained on")
        for name, value in tensors.items():
            if name.split(".")[0] in FIELD:
                self.nets.tensors[name].copy_(torch.as_tensor(value))
        self.given = header.provenance

    def carve(self) -> None:
        """Give the density a first shape, before the first step; none unless the recipe has one."""

    def occupied(self) -> Occupancy:
        """Where the field has matter now, for pictures of it."""
        raise NotImplementedError

    def parameters(self) -> dict[str, torch.Tensor]:
        """Name → tensor of all that is trained."""
        return self.nets.tensors

    def snapshot(self) -> dict:
        """A copy of all that validation judges, for :meth:`adopt`."""
        return {"tensors": {k: v.detach().clone() for k, v in self.parameters().items()}}

    @torch.no_grad()
    def adopt(self, snapshot: dict) -> None:
        """Go back to a :meth:`snapshot`."""
        parameters = self.parameters()
        for name, value in snapshot["tensors"].items():
            parameters[name].copy_(value)

    def state(self) -> dict:
        """A copy of all that decides the next step: a run that takes it up is the same run."""
        return copy.deepcopy({
            "held": {k: getattr(self, k) for k in (*self.HELD, *self.OWN)}, "random": self.generator.get_state(),
            "tensors": {k: v.detach() for k, v in self.parameters().items()},
            "optimizers": {k: o.state_dict() for k, o in self.optimizers.items()}, "watch": self.watch.seen,
            "grids": {k: {name: getattr(getattr(self, k), name) for name in names if hasattr(getattr(self, k), name)}
                      for k, names in self.GRIDS}})

    def restore(self, state: dict) -> None:
        """Take up a :meth:`state`."""
        state = copy.deepcopy(state)
        Recipe.adopt(self, state)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        for name, values in state["grids"].items():
            for key, value in values.items():
                setattr(getattr(self, name), key, value)
        for name, value in state["held"].items():
            setattr(self, name, value)
        self.watch.seen = state["watch"]
        self.generator.set_state(state["random"].cpu())

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


def total(terms: dict[str, torch.Tensor]) -> torch.Tensor:
    """The sum of `terms`, from the first to the last: its last bit is part of what makes a run reproducible."""
    return functools.reduce(torch.add, terms.values())
