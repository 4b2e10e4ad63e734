"""``visibility=auto`` under a limit: a pilot decides which method renders the picture, and what is left out of it.

Some camera rays are rendered by the march first, then by each candidate, on the same random numbers: the deviation is
the error that a picture would have, the clock tells its seconds. Under `max_error` the fastest whose error is below it,
with the confidence of the pilot, renders the picture; under `time_budget` the one whose error is least when the time is
over, bias and noise together.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import mitsuba as mi

from ..scene import effects
from ..scene.settings import Limits, Settings
from . import candidates
from .composition import Composition
from .pilot import BLOCKS, RAYS, Error, Look, Pilot

SHARE = 0.1
"""Fraction of a picture's time that the looks of a pilot may take."""
IN_VAIN = 1 / 3
"""Fraction of a picture's time that may go into building what is then not used."""
GLINTS = 4
"""Times as many rays look for glints, without shadows, where a specular lobe meets fewer lights: a glint is seen in a
thousandth of the pixels."""


@dataclass(frozen=True)
class Trial:
    """A candidate: predicted `seconds` of a picture, `error` and its upper `bound` (nan: not tried); the verdict."""

    name: str
    seconds: float = math.nan
    error: float = math.nan
    bound: float = math.nan
    taken: bool = False
    why: str = ""


@dataclass
class Choice:
    """The composition to render with; the trials in order; predicted ``seconds``, ``error`` and ``bound``.

    `key`: what further frames must have in common with this one to be rendered alike.
    """

    composition: Composition
    trials: list[Trial] = field(default_factory=list)
    predicted: dict = field(default_factory=dict)
    key: tuple = ()

    @property
    def effects(self) -> effects.Effects:
        """Effects of the composition, with the pilot's reason for the method."""
        taken = [t for t in self.trials if t.taken]
        return replace(self.composition.effects, reason=taken[-1].why) if taken else self.composition.effects

    def kept(self) -> tuple | None:
        """Return what a further frame needs of this choice, which holds no scene; None where none was made."""
        return (self.key, self.composition.settings, self.trials, self.predicted) if self.trials else None


class Chooser:
    """The choice for a render of `scene` by `settings` under `limits`, with `spp` samples a pixel.

    patches  of an earlier render of the same fields, or None
    gone     function that returns the seconds since the render began
    before   :meth:`Choice.kept` of an earlier frame, or None
    whole    nothing may be left out
    """

    def __init__(self, scene, settings: Settings, limits: Limits, sensor, spp: int, patches=None,
                 gone: Callable[[], float] = lambda: 0.0, before: tuple | None = None, whole: bool = False):
        self._scene, self._settings, self._limits, self._sensor = scene, settings, limits, sensor
        self._spp, self._patches, self._gone, self._before, self._whole = spp, patches, gone, before, whole
        self._rays = math.prod(int(n) for n in sensor.film().crop_size()) * spp
        self._trials: list[Trial] = []
        self._all_glints: list[Look] = []  # of all lights, once it is wanted
        self._spent = self._vain = 0.0

    def choose(self) -> Choice:
        """Return the choice. A method that the user named stays, whatever its error."""
        named = self._settings.visibility != "auto"
        if not self._limits.error and (named or not self._limits.seconds):
            return Choice(self._composed(self._settings))
        first = self._composed(self._settings if named else self._settings.but(visibility="raymarch"))
        key = self._settings, self._limits, self._rays, tuple(first.lights.kinds), len(first.lights.rows.power)
        if self._before and self._before[0] == key:
            _, settings, trials, predicted = self._before
            return Choice(self._composed(settings), trials, predicted, key)
        scene = first.effects
        if scene.gradients or not scene.needs_visibility or scene.visibility == "none":
            return Choice(first)
        small = SHARE * self._rays * self._settings.frames < RAYS  # the pilot would be a large part of the picture
        if self._limits.error and small and not self._limits.of_samples:
            return Choice(first)
        self._pilot = Pilot(self._sensor, first.media)
        choice = self._by_error(first, named) if self._limits.error else self._by_time(first)
        return replace(choice, key=key)

    def explain(self) -> Choice:
        """Return the choice with a prediction, also where no limit asks for one."""
        choice = self.choose()
        if choice.predicted or not choice.composition.effects.lit:
            return choice
        self._pilot = Pilot(self._sensor, choice.composition.media)
        look, error = self._judged(choice.composition)
        return Choice(look.composition, choice.trials, self._predicted(self._seconds(look), error))

    def _composed(self, settings: Settings) -> Composition:
        composition = Composition(self._scene, settings, self._sensor, self._spp, self._patches)
        self._patches = composition.patches  # where light bounces between is the same for all of them
        return composition

    def _look(self, settings: Settings, composition: Composition | None = None) -> Look:
        look = self._pilot.look(lambda: composition or self._composed(settings))
        self._spent += look.took - look.compiling
        return look

    def _judged(self, first: Composition) -> tuple[Look, Error]:
        """Return the first look, and its error against the march, which is the truth from then on."""
        look = self._truth = self._look(first.settings, first)
        if first.effects.needs_visibility and first.effects.visibility != "raymarch":
            self._truth = self._look(first.settings.but(visibility="raymarch"))
        return look, self._pilot.error(look, self._truth, self._samples())

    def _samples(self) -> float:
        """Return the samples a pixel of the picture, as far as they are known."""
        noise = self._limits.noise
        return self._pilot.samples_for(noise, self._truth) if noise > 0 else self._spp

    def _seconds(self, look: Look) -> float:
        """Return the seconds of a picture."""
        return look.built / self._shared(look.composition.settings) + look.each * self._samples()

    def _shared(self, settings: Settings) -> int:
        """Return the frames that share what is built: lights may move from one to the next."""
        return self._settings.frames if candidates.per_field(settings) else 1

    @staticmethod
    def _predicted(seconds: float, error: tuple[float, float]) -> dict:
        return {"seconds": seconds, "error": error[0], "bound": error[1]}

    def _by_error(self, first: Composition, named: bool) -> Choice:
        """Return the fastest choice whose error has an upper bound below `max_error`."""
        look, error = self._judged(first)
        why = "named" if named else "the march, whose error is 0 by definition"
        best = Trial(self._name(first.settings), self._seconds(look), *error, True, why)
        self._trials.append(best)
        for settings, rays in () if named else candidates.methods(first):
            building = self._building(rays)
            if building / self._shared(settings) > best.seconds or not self._affordable(best, building):
                self._pass(settings)
                continue
            best, look = self._tried(settings, best, look)
        for leave_out in () if self._whole else candidates.OMISSIONS:
            while (less := leave_out(look.composition)) is not None and self._affordable(best, 0.0):
                before = best
                best, look = self._tried(less, best, look)
                if best is before:
                    break
        return Choice(look.composition, self._trials, self._predicted(best.seconds, (best.error, best.bound)))

    def _name(self, settings: Settings) -> str:
        return candidates.name(settings, self._settings)

    def _pass(self, settings: Settings) -> None:
        self._trials.append(Trial(self._name(settings), why="not tried: it would take too much of the time"))

    def _tried(self, settings: Settings, best: Trial, look: Look) -> tuple[Trial, Look]:
        """Look at a candidate; return it and its look if it is better than `best`, else `best` and its look."""
        other = self._look(settings)
        error, seconds = self._pilot.error(other, self._truth, self._samples()), self._seconds(other)
        if error.bound <= self._limits.error and settings.environment_lights < self._settings.environment_lights:
            error = max(error, self._glints(other.composition), key=lambda e: e.bound)
        good = error.bound <= self._limits.error
        taken = good and seconds < best.seconds
        why = "the fastest within max_error" if taken else "no faster" if good else "its error may exceed max_error"
        trial = Trial(self._name(settings), seconds, *error, taken, why)
        self._trials.append(trial)
        if taken:
            return trial, other
        self._vain += other.built
        return best, look

    def _glints(self, fewer: Composition) -> Error:
        """Return the error that fewer lights of an environment make without shadows, seen by many rays."""
        if not fewer.effects.specular:
            return Error(0.0, 0.0)
        pilot = Pilot(self._sensor, fewer.media, GLINTS * BLOCKS)
        wanted = fewer.settings.but(visibility="none", max_depth=2)
        counts = (fewer.settings.environment_lights, *([] if self._all_glints else [self._settings.environment_lights]))
        look, *truth = (pilot.look(partial(self._composed, wanted.but(environment_lights=n))) for n in counts)
        self._all_glints += truth
        self._spent += sum(each.took - each.compiling for each in (look, *truth))
        return pilot.error(look, self._all_glints[0], self._samples())

    def _affordable(self, best: Trial, building: float) -> bool:
        """Return True if another look is a small part of the time of all frames, and so is what it builds in vain."""
        seconds = best.seconds * self._settings.frames
        spent = self._spent * (1 + 1 / len(self._trials))
        return spent <= SHARE * seconds and self._vain + building <= IN_VAIN * seconds

    def _building(self, rays: int) -> float:
        """Return the expected seconds of filling a map or an atlas by so many rays: each costs about a march."""
        march = self._truth.composition
        marched = self._rays / self._spp * max(effects.shadow_rays(march.settings, march.lights), 1)
        return rays * self._truth.each / marched

    def _by_time(self, march: Composition) -> Choice:
        """Return the choice whose error is least when the time is over, bias and noise together."""
        look, _ = self._judged(march)
        least = self._end(look)
        self._trials.append(Trial("raymarch", self._limits.seconds, *least, True, "the least error in this time"))
        for settings, rays in candidates.methods(march):
            if look.took + self._building(rays) > IN_VAIN * self._left():
                self._pass(settings)
                continue
            other = self._look(settings)
            end = self._end(other)
            taken = end.bound < least.bound
            why = "the least error in this time" if taken else "a larger error in this time"
            self._trials.append(Trial(self._name(settings), self._limits.seconds, *end, taken, why))
            look, least = (other, end) if taken else (look, least)
        if look.each > self._left():
            mi.Log(  # type: ignore[operator]  # an object in the stub
                mi.LogLevel.Warn,
                f"nrf integrator: time_budget is {self._limits.seconds:.3g} s, but one sample a pixel takes about "
                f"{look.each:.3g} s by {look.composition.effects.visibility}; that will be rendered")
        return Choice(look.composition, self._trials, self._predicted(self._limits.seconds, least))

    def _left(self) -> float:
        return max(self._limits.seconds - self._gone(), 1e-3)

    def _end(self, look: Look) -> Error:
        """Return the error of a picture by the time that is left, bias and noise together."""
        samples = self._left() / max(look.each, 1e-9)
        noise = self._pilot.noise(self._truth) / math.sqrt(max(samples, 1e-3))
        return Error(*(math.hypot(e, noise) for e in self._pilot.error(look, self._truth, max(samples, 1.0))))
