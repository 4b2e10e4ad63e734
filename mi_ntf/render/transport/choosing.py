"""``visibility=auto`` under a limit: a pilot decides on the method and on effects that are left out.

Some camera rays are rendered by the march first, then by each candidate on the same random numbers. Their deviation is
the error that a picture would have, and the clock gives the time. Under `max_error` the fastest candidate renders the
picture whose error is below it, with the confidence of the pilot. Under `time_budget` it is the candidate with the
least error, bias and noise together, at the end of that time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import mitsuba as mi

from ...core.quantities import duration
from ...infer.visibility import REGISTRY
from .. import log
from ..scene.recent import Version
from ..scene.settings import Limits, Settings
from . import candidates, effects
from .bounced import Patches
from .composition import Composition
from .pilot import BLOCKS, RAYS, Error, Look, Pilot

PILOT_FRACTION = 0.1
"""Fraction of a picture's time that a pilot may take."""
VAIN_FRACTION = 1 / 3
"""Fraction of a picture's time that may be spent on building tables that are not used."""
GLINT_BLOCKS = 4 * BLOCKS
"""Blocks of the pilot for highlights of few lights, which are visible in a thousandth of the pixels."""


@dataclass(frozen=True)
class Trial:
    """A candidate with its predicted seconds, error and upper bound of the error; nan: it was not tried."""

    name: str
    seconds: float = math.nan
    error: float = math.nan
    bound: float = math.nan
    taken: bool = False
    why: str = ""


@dataclass(frozen=True)
class Choice:
    """Settings to render with, the trials in order, and the best trial; None: no pilot was needed.

    `key`: pictures with an equal key are rendered alike. `method_key`: frames with an equal one share the method if
    `frames` says so, but not what is left out.
    """

    settings: Settings
    trials: Sequence[Trial] = ()
    best: Trial | None = None
    method_key: tuple[object, ...] = ()
    key: tuple[object, ...] = ()

    @property
    def predicted(self) -> dict[str, float]:
        """Predicted ``seconds``, ``error`` and ``bound``; empty without a pilot."""
        return {name: getattr(self.best, name) for name in ("seconds", "error", "bound")} if self.best else {}


class Chooser:
    """Choice of a method for a render of `scene` by `settings` under `limits`, with `spp` samples per pixel.

    patches   of an earlier render of the same fields, or None
    elapsed   function that returns the seconds since the render began
    previous  choice for an earlier frame, or None
    complete  no effect may be left out
    """

    def __init__(self, scene: mi.Scene, settings: Settings, limits: Limits, sensor: mi.Sensor, spp: int, *,
                 patches: Patches | None = None, elapsed: Callable[[], float] = lambda: 0.0,
                 previous: Choice | None = None, complete: bool = False) -> None:
        self._scene, self._settings, self._limits, self._sensor = scene, settings, limits, sensor
        self._spp, self._patches, self._elapsed, self._previous = spp, patches, elapsed, previous
        self._complete, self._by_time = complete, limits.seconds > 0 and not limits.error
        self._rays = math.prod(int(n) for n in sensor.film().crop_size()) * spp
        self._trials: list[Trial] = []
        self._best = Trial("")
        self._glints_of_all: Look | None = None  # of all lights, once it is needed
        self._spent = self._vain = 0.0

    def choose(self) -> tuple[Composition, Choice]:
        """Return the composition to render, and the choice. A named method is never replaced, whatever its error."""
        named = self._settings.visibility != "auto"
        if not self._limits.error and (named or not self._limits.seconds):
            return self._composed(self._settings), Choice(self._settings)
        first = self._composed(self._settings if named else replace(self._settings, visibility="raymarch"))
        keys = self._keys(first)
        if self._previous and self._may_keep(self._previous, first, *keys):
            return self._composed(self._previous.settings), self._previous
        needs = first.effects
        small = PILOT_FRACTION * self._rays * self._settings.frames < RAYS
        if (needs.gradients or not needs.needs_visibility or needs.visibility == "none"
                or (small and self._limits.error and not self._limits.of_samples)):
            return first, Choice(first.settings)
        self._begin(first, "named" if named else "the least error in this time" if self._by_time
                    else "the march, whose error is 0 by definition")
        for settings, rays in () if named else candidates.methods(first):
            if self._affordable(settings, rays):
                self._try(self._look_at(settings))
            else:
                self._trials.append(Trial(candidates.name(settings, self._settings),
                                          why="not tried: it would take too much of the time"))
        for leave_out in () if self._complete or self._by_time else candidates.OMISSIONS:
            while ((less := leave_out(self._look.composition)) and self._affordable(less, 0)
                   and self._try(self._look_at(less))):
                pass
        composition, each = self._look.composition, self._look.each
        if self._by_time and each > self._time_left():
            log.warn(f"nrf integrator: time_budget is {duration(self._limits.seconds)}, but one sample a pixel takes "
                     f"about {duration(each)} by {composition.effects.visibility}; that will be rendered")
        return composition, Choice(composition.settings, self._trials, self._best, *keys)

    def explain(self) -> tuple[Composition, Choice]:
        """Return the same with a prediction even if no limit requires a pilot."""
        composition, choice = self.choose()
        if choice.best or not composition.effects.lit:
            return composition, choice
        self._begin(composition, composition.effects.reason)
        return composition, replace(choice, best=self._best)

    def _keys(self, first: Composition) -> tuple[tuple[object, ...], tuple[object, ...]]:
        """Return what the speed of methods follows from, and all that a picture depends on: places, lights, camera."""
        rows = first.lights.rows
        method = (self._settings, self._limits, self._rays, tuple(first.lights.kinds), len(rows.power),
                  tuple(m.field.appearance for m in first.media))
        return method, (method, Version(self._scene, self._sensor))

    def _may_keep(self, previous: Choice, first: Composition, method_key: tuple[object, ...], key: tuple[object, ...]
                  ) -> bool:
        """Return True if the choice for a `previous` picture is one for this picture too."""
        complete = candidates.is_complete(previous.settings, first.settings)
        return previous.key == key or (complete and self._settings.frames > 1 and previous.method_key == method_key)

    def _composed(self, settings: Settings) -> Composition:
        composition = Composition(self._scene, settings, self._sensor, self._spp, self._patches)
        self._patches = composition.patches  # they are the same for all candidates
        return composition

    def _counted(self, look: Look) -> Look:
        self._spent += look.took - look.compiling
        return look

    def _look_at(self, settings: Settings) -> Look:
        return self._counted(self._pilot.look(partial(self._composed, settings)))

    def _begin(self, first: Composition, why: str) -> None:
        """Render the pilot by `first`, the best candidate so far, and by the march, the truth from then on."""
        self._pilot = Pilot(self._sensor, first.media)
        look = self._truth = self._counted(self._pilot.look(lambda: first))
        if first.effects.needs_visibility and first.effects.visibility != "raymarch":
            self._truth = self._look_at(replace(first.settings, visibility="raymarch"))
        self._try(look, why)

    def _samples(self) -> float:
        """Return the samples per pixel of the picture, estimated if a limit of noise decides on them."""
        noise = self._limits.noise
        return self._pilot.samples_for(noise, self._truth) if noise > 0 else self._spp

    def _sharing(self, settings: Settings) -> int:
        """Return the number of frames that share the tables; lights may move from one frame to the next."""
        return self._settings.frames if REGISTRY[settings.visibility].per_field else 1

    def _try(self, look: Look, first: str = "") -> bool:
        """Take a look, and return True, if it is better than the best so far, or for the reason `first`."""
        settings, limit = look.composition.settings, self._limits.error
        name = candidates.name(settings, self._settings)
        if self._by_time:
            seconds, error = self._limits.seconds, self._error_in_time(look)
            better = bool(first) or error.bound < self._best.bound
            why = "the least error in this time" if better else "a larger error in this time"
        else:
            seconds = look.built / self._sharing(settings) + look.each * self._samples()
            error = self._pilot.error(look, self._truth, self._samples())
            if error.bound <= limit and settings.environment_lights < self._settings.environment_lights:
                error = max(error, self._glints(look.composition), key=lambda e: e.bound)
            good = error.bound <= limit
            better = bool(first) or (good and seconds < self._best.seconds)
            why = ("the fastest within max_error" if better else
                   "no faster" if good else "its error may exceed max_error")
        self._trials.append(Trial(name, seconds, *error, better, first or why))
        if better:
            self._look, self._best = look, self._trials[-1]
        else:
            self._vain += look.built
        return better

    def _error_in_time(self, look: Look) -> Error:
        """Return the error, bias and noise together, at the end of the time."""
        samples = self._time_left() / max(look.each, 1e-9)
        noise = self._pilot.noise(self._truth) / math.sqrt(max(samples, 1e-3))
        return Error(*(math.hypot(e, noise) for e in self._pilot.error(look, self._truth, max(samples, 1.0))))

    def _glints(self, fewer: Composition) -> Error:
        """Return the error of fewer lights of an environment without shadows, which a larger pilot finds."""
        if not fewer.effects.specular:
            return Error(0.0, 0.0)
        pilot = Pilot(self._sensor, fewer.media, GLINT_BLOCKS)

        def look(lights: int) -> Look:
            settings = replace(fewer.settings, visibility="none", max_depth=2, environment_lights=lights)
            return self._counted(pilot.look(partial(self._composed, settings)))

        of_fewer = look(fewer.settings.environment_lights)
        self._glints_of_all = self._glints_of_all or look(self._settings.environment_lights)
        return pilot.error(of_fewer, self._glints_of_all, self._samples())

    def _affordable(self, settings: Settings, rays: int) -> bool:
        """Return True if another look, and tables of so many rays that may not be used, take little of the time.

        A ray of a table costs about as much as a marched one.
        """
        march = self._truth.composition
        marched = self._rays / self._spp * max(effects.lights_per_point(march.settings, march.lights), 1)
        building = rays * self._truth.each / marched
        if self._by_time:
            return self._look.took + building <= VAIN_FRACTION * self._time_left()
        seconds = self._best.seconds * self._settings.frames
        spent = self._spent * (1 + 1 / len(self._trials))
        return (building / self._sharing(settings) <= self._best.seconds and spent <= PILOT_FRACTION * seconds
                and self._vain + building <= VAIN_FRACTION * seconds)

    def _time_left(self) -> float:
        return max(self._limits.seconds - self._elapsed(), 1e-3)
