"""Contract between the trainer and its recipes, and the parts of a run that they share."""

import functools
import math
import time
from dataclasses import dataclass, field
from typing import Protocol

import torch

from . import parallel
from .checkpoint import State
from .config import Config
from .monitor import Fault, Notes, Watch
from .networks import Networks, Tensors
from .occupancy import Occupancy
from .photometry import Gains
from .scoring import Light
from .training_data import TrainingData

FIELD = ("density", "reflectance")
"""Networks that photographs train; the others learn from the field."""
Snapshot = dict[str, Tensors]
"""Copies of tensors, by what they belong to."""


@dataclass
class Clock:
    """Steps and time of a run, and the limit of one of them."""

    minutes: float = math.inf
    steps: float = math.inf
    first: int = 0  # Steps that the field was trained for before this run
    begin: float = 0.0  # Time of the schedule at which this run begins, as a fraction
    step: int = 0
    spent: float = 0.0  # Seconds so far
    reserve: float = 0.0  # Seconds at the end for the scores and the page of the finished field
    last: float = field(default_factory=time.monotonic)
    """Moment up to which `spent` counts."""

    def tick(self) -> None:
        """Count the time since the last call as spent."""
        now = time.monotonic()
        self.spent, self.last = self.spent + now - self.last, now

    def count(self) -> None:
        """Count the time up to now as spent, and agree on it in all processes if it limits the run."""
        self.tick()
        if self.timed:
            self.spent = parallel.agreed(self.spent)

    @property
    def left(self) -> float:
        """Seconds that are left of a run that is limited by time; 0 of other ones."""
        return max(60 * self.minutes - self.spent - (time.monotonic() - self.last), 0.0) if self.timed else 0.0

    @property
    def timed(self) -> bool:
        """True if the run is limited by time."""
        return self.minutes < math.inf

    @property
    def progress(self) -> float:
        """Time of the schedule, as a fraction of a run, in [0, 1]."""
        done = max((self.step - self.first) / self.steps, self.spent / (60 * self.minutes - self.reserve))
        return self.begin + (1 - self.begin) * done


@dataclass
class Learner:
    """Optimisers of a run and the guards of their steps."""

    clock: Clock
    optimizers: dict[str, torch.optim.Optimizer] = field(default_factory=dict)
    """Optimisers by the name of their loss; the parameter groups have their learning rates as ``base``."""
    watch: Watch = field(default_factory=Watch)
    factor: float = 1.0
    """Factor of the learning rates; every fault halves it."""
    terms: Tensors = field(default_factory=dict)  # Weighted loss terms of the last step, by name
    rays: int = 0  # Camera rays that this process has trained on
    samples: int = 0  # Samples of these rays

    def check(self, name: str, loss: torch.Tensor) -> None:
        """Record the loss `name`, which is positive and of a known size. Raises Fault if it has diverged."""
        self.watch.check(name, float(loss.detach()), self.clock.step)

    def descend(self, name: str, loss: torch.Tensor, rate: float) -> float:
        """Take a step of the optimiser `name` at `rate` times its learning rates and return the loss. Raises Fault."""
        optimizer = self.optimizers[name]
        value = float(loss.detach())
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        parallel.average_gradients(parameters)
        size = float(torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None]))
        if not (math.isfinite(value) and math.isfinite(size)):
            raise Fault(f"the {name} loss is {value} and its gradient's length {size} at step {self.clock.step}")
        for group in optimizer.param_groups:
            group["lr"] = group["base"] * rate * self.factor
        optimizer.step()
        return value

    def state(self) -> State:
        """Return what decides the next step."""
        return {"factor": self.factor, "averages": self.watch.averages,
                "optimizers": {k: o.state_dict() for k, o in self.optimizers.items()}}

    def restore(self, state: State) -> None:
        """Restore a :meth:`state`."""
        self.factor, self.watch.averages = state["factor"], state["averages"]
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])


@dataclass(frozen=True)
class Run:
    """Parts of a run that the trainer shares with its recipe."""

    data: TrainingData
    clock: Clock
    learner: Learner
    notes: Notes
    generator: torch.Generator


class Recipe(Protocol):
    """Method of training a field: its steps, its schedule, and its state."""

    networks: Networks

    @property
    def config(self) -> Config:
        """Settings, adapted to the photographs."""

    @property
    def field_until(self) -> float:
        """Time, as a fraction of the run, at which the field is finished and only its transmittance is trained."""

    @property
    def gains(self) -> Gains | None:
        """Exposure and white balance of the photographs, if they are learned."""

    @property
    def light(self) -> Light:
        """Light of the photographs, as learned so far."""

    def carve(self) -> None:
        """Give the density a first shape, before the first step of a new field."""

    def advance(self) -> float:
        """Take one step of all that the schedule trains now and return the loss. Raises Fault."""

    def occupied(self) -> Occupancy:
        """Return where the field has matter now, for pictures of it."""

    def parameters(self) -> Tensors:
        """Return all that is trained, by name."""

    def snapshot(self) -> Snapshot:
        """Return a copy of all that validation judges."""

    def adopt(self, snapshot: Snapshot) -> None:
        """Go back to a :meth:`snapshot`."""

    def state(self) -> State:
        """Return all else that decides the next step; parameters, optimisers and random numbers are the trainer's."""

    def restore(self, state: State) -> None:
        """Restore a :meth:`state`."""


@torch.no_grad()
def copy_into(parameters: Tensors, values: Tensors) -> None:
    """Copy `values` into the parameters of the same names."""
    for name, value in values.items():
        parameters[name].copy_(value)


def total(terms: Tensors) -> torch.Tensor:
    """Return the sum of `terms`, added from first to last: the order makes a run reproducible to the last bit."""
    return functools.reduce(torch.add, terms.values())
