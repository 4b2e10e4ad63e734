"""State of an ``nrf`` integrator: its settings, what it takes from earlier renders, and what it reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from ..scene.settings import NO_LIMITS, Limits, Settings
from .bounced import Patches
from .camera_light import SampleCache
from .choosing import Choice


@dataclass
class RenderContext:
    """Settings of a render, state that further renders may use, and the result.

    settings        properties of the integrator
    limits          limits of noise, error and time
    timeout         seconds after which rendering stops; below 0: never
    aovs            names of the further outputs
    rays_in_flight  camera rays traced at once; 0: the default
    patches         patches of the last render, for multiple scattering between the same fields
    choice          choice of the last render under limits, for further frames
    sample_cache    samples of the same camera rays from earlier renders; None: nothing is cached
    light_count     number of lights in the table of the last render
    achieved        result of the last render: ``visibility``, ``reason``, ``spp``, ``passes``, ``noise``, ``seconds``,
                    ``ended``, ``predicted``, ``trials``
    """

    settings: Settings
    limits: Limits = NO_LIMITS
    timeout: float = -1.0
    aovs: tuple[str, ...] = ()
    rays_in_flight: int = 0
    patches: Patches | None = None
    choice: Choice | None = None
    sample_cache: SampleCache | None = None
    light_count: int = 0
    achieved: dict[str, Any] = field(default_factory=dict)


def context_of(scene: mi.Scene) -> RenderContext:
    """Return the context of a scene's integrator, which is ``nrf``."""
    context: RenderContext = vars(scene.integrator())["context"]
    return context
