"""Settings that a picture may be rendered with, tried on some of its pixels: what each takes, and how far off it is."""

import math
from dataclasses import replace

import numpy as np

from ...infer.visibility import REGISTRY
from ..scene.settings import Limits, Settings
from .choice import Trial
from .composition import Composition
from .estimate import Estimate
from .probing import CAUTION, LEAST, Look, Off, Probes, probed

MARGIN = 0.95
"""Of `max_error`, what the probes may show: what is taken is what they happen to find good."""
RISKED, DOUBTED = 0.4, 0.1
"""Of what a trial may save, what it may take; and what more pixels may where those so far rather tell that it fails."""
CHEAP = 0.01
"""Of the seconds of all frames, what more pixels may take in any case: of the lights that `statue` may do without under
an environment, 500 pixels find too many."""
CLOSER = 4
"""Times as many pixels are looked at where that costs nothing."""
BRIEF = 0.05
"""Seconds, less than which a look takes as long as its kernels need to begin, not what they compute."""
EVERYWHERE, FEW = 16384, 32
"""Pixels and lights of an environment in which is looked for what the picture shows, without shadows; the probes are
some of them. Half of them where all frames take less than `SHORT` seconds, a quarter where less than half of that."""
SHORT = 2.0
FEWER = 2
"""Times fewer probes are in smoke, where each has more points. With a fourth they would be too few to tell what half of
the lights save."""
TOLD = 2
"""Times fewer of them are marched to where a method that serves all lights is cheap: what that errs by is the smaller
part of the error of fewer lights, and all of the probes tell the larger one by that method."""
MARCHED = 128
"""Lights of an environment that the probes march to in smoke, where a method that costs little adds what all change:
512 took a third of the time of a picture of `cloud`. Skins need all: what an atlas errs by is each light's own there,
and of fewer lights half as much again."""
UNTOLD = 32
"""Samples a pixel that a render is taken to have if a limit of noise says how many."""


class Trials:
    """For one render of `scene` by `settings` and `limits`, with `spp` samples a pixel unless a limit says how many.

    trials    what was tried, in order
    estimate  of seconds, before anything is tried
    probes    the pixels that are looked at, from :meth:`_marched` on; `truth`: by the march, what they show, of fewer
              lights until :meth:`_with_all_lights`; `known`: it can be found of any pixel
    """

    estimate: Estimate
    probes: Probes
    truth: Look

    def __init__(self, scene, settings: Settings, limits: Limits, sensor, spp: int, patches):
        self.scene, self.settings, self.limits, self.sensor, self.patches = scene, settings, limits, sensor, patches
        self._spp = UNTOLD if limits.noise > 0 else spp
        self._size = tuple(int(n) for n in sensor.film().crop_size())
        self.trials: list[Trial] = []
        self._most = MARGIN * limits.error
        self._errors: dict[Settings, float] = {}
        self._others: tuple[Composition, Composition] | None = None  # their difference: the lights that truth lacks
        self._off: Off | None = None
        self.known = True

    def _composed(self, settings: Settings) -> Composition:
        return Composition(self.scene, settings, self.sensor, self._spp, self.patches)

    def _looked(self, settings: Settings) -> Look:
        look = self.probes.look(lambda: self._composed(settings))
        self.patches = look.composition.patches  # where light bounces between is the same for all of them
        return look

    def _closer(self, look: Look, saved: float) -> Look:
        """`look`, which would save so many seconds a picture; through more pixels, from then on, where that costs next
        to nothing, or where it is chance that refuses what would save much."""
        spent, frames = 0.0, self.settings.frames
        while self.known:
            chance = self._error(look, -CAUTION) <= self._most < self._error(look)
            risked = RISKED if self._error(look, 0.0) <= self._most else DOUBTED
            worth = frames * max(CHEAP * self._price(look), risked * saved if chance else 0.0) - spent
            if chance and self._off and self._off.probes.count < self.probes.count:
                rest = self.probes.after(self._off.probes)
                seconds = rest.samples * self._off.march.each
                if seconds <= worth:
                    spent += seconds
                    self._march_rest(self._off, rest)
                    continue
            seconds = (TOLD if self._few else 1) * self.probes.samples * (self.truth.each + look.each)
            if seconds > worth or 2 * self.probes.count > self._everywhere.count:
                break
            spent += seconds
            look = self._through_more(look)
        return look

    def _march_rest(self, known: Off, rest: Probes) -> None:
        """What the truth is off by at the `rest` of the probes as well."""
        march = rest.look(lambda: known.march.composition)
        off = self.truth.radiance[known.probes.count:] - march.radiance
        self._off = Off(self.probes, np.concatenate([known.by, off]), march)

    def _through_more(self, look: Look) -> Look:
        """`look` through twice as many pixels, as the truth is from then on."""
        more, both = self.probes.more()
        share = more.samples / both.samples
        march = more.look(lambda: self.truth.composition)
        self.truth = self.truth.and_more(self._and_others(more, march), share)
        look = look.and_more(more.look(lambda: look.composition), share)
        self.probes = both
        return look

    def _and_others(self, probes: Probes, march: Look, whole: Look | None = None) -> Look:
        """`march` of `probes` with the lights that it lacks; `whole`: what a method shows of all, if that is known."""
        if self._others is None:
            return march
        of_all, of_few = self._others
        whole, fewer = whole or probes.look(lambda: of_all), probes.look(lambda: of_few)
        return replace(march, radiance=march.radiance + whole.radiance - fewer.radiance)

    def _with_all_lights(self, look: Look) -> None:
        """The truth with those that were not marched to, as a method shows them whose `look` has all."""
        settings, fewer = look.composition.settings, self.truth.composition.settings.environment_lights
        if self._others is None and fewer != settings.environment_lights:
            self._others = look.composition, self._composed(settings.but(environment_lights=fewer))
            self.truth = self._and_others(self.probes, self.truth, look)

    def _fewer_lights(self, march: Settings) -> Settings:
        """With as few as the probes march to."""
        lights, smoke = self.estimate.lights, self._shown.composition.smoke
        many = any(d.shining > MARCHED for d in lights.discrete)
        drawn = march.light_samples or lights.sampled or self.estimate.effects.bounces
        return march.but(environment_lights=MARCHED) if smoke and many and not drawn else march

    def _marched(self, march: Settings, whole: bool = True) -> None:
        """The probes by the march, which also tell how far off the prices are; `whole`: all of them, with all lights,
        whatever that takes."""
        pixels = math.prod(self._size)
        seconds = self.estimate.seconds(march) * self.settings.frames
        share = 4 if seconds < SHORT / 2 else 2 if seconds < SHORT else 1
        self._everywhere = Probes(self.sensor, self.estimate.media, EVERYWHERE // share)
        self._shown = self._everywhere.look(lambda: self._composed(march.but(
            visibility="none", max_depth=2, hide_emitters=True,
            environment_lights=min(FEW, march.environment_lights))))
        smoke = self._shown.composition.smoke
        self.probes = self._everywhere.some(self._shown, round(probed(pixels) * pixels / (FEWER if smoke else 1)))
        self._few = not whole and not smoke and self.probes.count >= LEAST
        if self._few:
            self.probes = self.probes.first(1 / TOLD)
        march = march if whole else self._fewer_lights(march)
        self.truth = self._looked(march)
        if self.truth.each * self.probes.samples < BRIEF / (TOLD if self._few else 1):
            self.probes = self._everywhere.some(self._shown, CLOSER * self.probes.count)
            self.truth = replace(self.probes.look(lambda: self.truth.composition), built=self.truth.built)
        self._reckon()

    def _reckon(self) -> None:
        """Prices as the march has just shown."""
        march = self.truth.composition.settings
        self.estimate.dearer *= self._price(self.truth) / max(self.estimate.seconds(march), 1e-9)

    def _all_probes(self, look: Look) -> Look:
        """`look` through all of the probes, of which the march has seen few: as the truth, from then on, with what it
        was off by there."""
        if not self._few:
            return look
        if look is self.truth and len(self.estimate.lights.rows.power) < FEW:
            self._few = False  # fewer lights are not looked for
            return look
        more, both = self.probes.more(TOLD)
        if look is not self.truth:
            self._off = Off(self.probes, look.radiance - self.truth.radiance, self.truth)
        if more.count:  # small pictures have no others
            look = look.and_more(more.look(lambda: look.composition), more.samples / both.samples)
        self.truth, self.probes, self._few = look, both, False
        return self.truth

    def _price(self, look: Look) -> float:
        """Seconds of a picture, what is built shared among the frames that it serves."""
        return look.built / self._served(look.composition.settings) + look.each * self._spp

    def _saved(self, settings: Settings, best: Trial, look: Look) -> tuple[float, float]:
        """Seconds that a picture by `settings` may take less than the `best`, and those of what is built anew for it:
        what is built for a field is there."""
        now = look.composition.settings
        if REGISTRY[settings.visibility].per_field:
            return self._spp * look.each * (1 - self.estimate.each(settings) / self.estimate.each(now)), 0.0
        share = self.estimate.seconds(settings) / self.estimate.seconds(now)
        return best.seconds * (1 - share), self.estimate.built(settings)

    def _served(self, settings: Settings) -> int:
        """Frames that share what is built."""
        return self.settings.frames if self.settings.still or REGISTRY[settings.visibility].per_field else 1

    def _error(self, look: Look, caution: float = CAUTION) -> float:
        return self.probes.error(look, self.truth, self._spp, caution, self._off)

    def _judged(self, look: Look, taken: bool, why: str, what: str = "") -> Trial:
        error = self._error(look)
        self._errors[look.composition.settings] = error
        return self._tried(look.composition.settings, self._price(look), error, taken, why, what)

    def _tried(self, settings: Settings, seconds: float, error: float = math.nan, taken: bool = False, why: str = "",
               what: str = "") -> Trial:
        self.trials.append(Trial(self._name(settings, what), seconds, error, taken, why))
        return self.trials[-1]

    @staticmethod
    def _name(settings: Settings, what: str = "") -> str:
        dials = [f"{settings.map_resolution}², {settings.map_components} logistics"] if REGISTRY[
            settings.visibility].drawn else []
        return " ".join([settings.visibility, *dials, *([f"without {what}"] if what else [])])
