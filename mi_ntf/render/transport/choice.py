"""What was looked at before a render, and what came of it."""

import math
from dataclasses import dataclass, field, replace

from ..scene import effects
from ..scene.settings import Settings
from .composition import Composition


@dataclass(frozen=True)
class Trial:
    """Something in place of the march of all that the scene calls for: `name`, its `error` (relative RMSE; nan: not
    measured) and `seconds` of a picture, predicted or those of its probes; whether it is `taken`, and why."""

    name: str
    seconds: float
    error: float = math.nan
    taken: bool = False
    why: str = ""


@dataclass
class Choice:
    """`composition`: to render with; `trials`: what was looked at, in order; `predicted`: seconds, error."""

    composition: Composition
    trials: list[Trial] = field(default_factory=list)
    predicted: dict = field(default_factory=dict)

    @property
    def effects(self) -> effects.Effects:
        """Those of the composition, with what the trials say for its method."""
        found, taken = self.composition.effects, [t for t in self.trials if t.taken]
        return replace(found, reason=taken[-1].why) if taken else found

    def told(self) -> dict:
        """``predicted`` and ``trials`` as numbers and words."""
        return {"predicted": self.predicted, "trials": [vars(t) for t in self.trials]}


@dataclass(frozen=True)
class Kept:
    """A choice for frames to come that have the same `key`; `placed`: where lights and fields were; `moved`: whether
    they have been elsewhere; `dearer`: that of :class:`mi_ntf.render.transport.estimate.Estimate`."""

    key: tuple
    placed: tuple
    moved: bool
    dearer: float
    settings: Settings
    trials: list[Trial]
    predicted: dict
