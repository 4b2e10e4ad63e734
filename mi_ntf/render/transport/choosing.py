"""``visibility=auto`` under a limit: which method, with which dials, and what is not worth its price.

Some pixels are rendered beforehand by the march and by what is cheaper: the difference is the error that a picture
would have, and their seconds are this machine's own prices. The cheapest that keeps to `max_error` renders the picture;
under a `time_budget` alone, what has the smallest error when the time is over, bias and noise together.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi

from ...infer.visibility import REGISTRY
from ..maps import building
from ..scene.settings import Limits, Settings
from . import estimate
from .choice import Choice, Kept, Trial
from .estimate import Estimate
from .glints import Glints
from .omissions import LIGHTS, OMISSIONS, halved
from .probing import SAMPLES, Look, probed
from .trials import RISKED, Trials

LOOK, TRIAL, LEFT_OUT = 0.5, 0.08, 0.12
"""Seconds of all frames: what takes less is rendered by the march without a look at it; what another method must save
to be tried, twice what that takes with kernels compiled; and what leaving something out must. Under a `time_budget`
a trial counts as `LOOK`: it may compile."""
TOO_FAR = "off by more than max_error allows"
SAVING = 0.1
"""Of the predicted time, what leaving something out must save at least."""
FINER = {"map_resolution": 256, "map_components": 2}
"""Dials of a map for smaller errors."""
SPARED, WORTH = 0.2, 0.7
"""Of the time that is left, what a trial may take under a `time_budget`; `RISKED` of it where its error, as far as it
can be foreseen, is below `WORTH` of the least so far: a march of two samples is far off, an atlas takes a second."""
HOPELESS = 1.5
"""Maps of one logistic are not tried where their usual error is so many times `max_error`."""


class Chooser(Trials):
    """Choice of method and dials for a render by `settings`.

    `gone`: seconds that it has taken so far; `before`: :meth:`kept` of an earlier frame; `whole`: nothing is left out,
    whatever it is worth. All else as in :class:`Trials`.
    """

    def __init__(self, scene, settings: Settings, limits: Limits, sensor, spp: int, patches,
                 gone: Callable[[], float] = lambda: 0.0, before=None, whole: bool = False):
        super().__init__(scene, settings, limits, sensor, spp, patches)
        self._gone, self._before, self._whole = gone, before, whole
        self._moved = False

    def choose(self) -> Choice:
        """Return the choice that keeps to the limits. A method that the user named stays, whatever its error."""
        by_time = self.limits.seconds > 0 and self.settings.visibility == "auto"
        if not self.limits.error and not by_time:
            return Choice(self._composed(self.settings))
        self.estimate = Estimate(self.scene, self.settings, self.sensor, self._size[0] * self._size[1], self._spp)
        self.settings = building.resolved(self.settings, len(self.estimate.lights.rows.power), self.estimate.media)
        self._glints = Glints(self._composed, self.estimate, self.sensor, self.settings)
        found = self.estimate.effects
        if found.gradients or not found.needs_visibility or found.visibility == "none":
            return Choice(self._composed(self.settings))
        before = self._before
        if before and before.key == self._key():
            self._moved = before.moved or before.placed != self._placed()
            again = self._worth_again(before)
            if not again and not (before.settings.still and self._moved):
                self.trials = before.trials
                return Choice(self._composed(before.settings), self.trials, before.predicted)
            self.settings = self.settings.but(still=again)
        return self._by_error() if self.limits.error else self._by_time()

    def kept(self, choice: Choice) -> Kept | None:
        """For the next frame: where it is one of the same scene with as many lights, the choice is made once."""
        if not choice.trials:
            return None
        return Kept(self._key(), self._placed(), self._moved, self.estimate.dearer, choice.composition.settings,
                    choice.trials, choice.predicted)

    def _key(self) -> tuple:
        lights = self.estimate.lights
        return (id(self.scene), self.settings.but(still=False), self.limits, self._size, self._spp,
                tuple(lights.kinds), len(lights.rows.power))

    def _placed(self) -> tuple:
        """Return the places of fields and lights."""
        rows = self.estimate.lights.rows
        return rows.where.tobytes(), *(m.frame.placement() for m in self.estimate.media)

    def _worth_again(self, before: Kept) -> bool:
        """Return True if maps may pay, since the lights have not moved so far and further frames share the maps."""
        if before.settings.still or self._moved or self.settings.visibility != "auto" or not self.limits.error:
            return False
        self.estimate.dearer = before.dearer
        off = {t.name for t in before.trials if t.why == TOO_FAR}
        found = [self.estimate.seconds(self._whole_of(s))
                 for s in self._candidates(self._plain(self.settings.but(still=True)), False)
                 if self._name(s) not in off and not self._hopeless(s)]
        return bool(found) and self._pays(before.predicted["seconds"] - min(found), LOOK + TRIAL)

    def _pays(self, saved: float, lost: float) -> bool:
        """Return True if `saved` seconds a picture are worth `lost` seconds of a trial and of building."""
        return saved * self.settings.frames >= lost

    def _by_error(self) -> Choice:
        named = self.settings.visibility != "auto"
        first = self.settings if named else self.settings.but(visibility="raymarch")
        seconds = self.estimate.seconds(first)
        if seconds * self.settings.frames < LOOK:
            error, why = (math.nan, "named") if named else (0.0, "all else saves less than a trial takes")
            best = self._tried(first, seconds, error, True, why)
            return Choice(self._composed(first), self.trials, {"seconds": best.seconds, "error": best.error})
        plain = self._plain(self.settings)
        march = plain.but(visibility="raymarch")
        self._marched(march, whole=named and not REGISTRY[plain.visibility].per_field)
        best, look = self._as_named(plain) if named else self._for_all_lights(plain)
        look = self._all_probes(look)
        if plain != self.settings:
            best, look = self._with_bounces(best, look)
        if not self._whole:
            best, look = self._without(best, look, OMISSIONS, self._most)
        if not named:
            maps = self._candidates(look.composition.settings, False)
            best, look = self._cheaper(best, maps, self._looked, lambda _: 0.0) or (best, look)
        return Choice(look.composition, self.trials, {"seconds": best.seconds, "error": best.error})

    def _plain(self, settings: Settings) -> Settings:
        """Without bounces between patches, which the march would light at the price of a picture; as they only add to
        what is seen, they come afterwards."""
        return settings.but(max_depth=2) if self.estimate.effects.bounces == "radiosity" else settings

    def _whole_of(self, plain: Settings) -> Settings:
        """With the bounces again that :meth:`_plain` left out."""
        return plain.but(max_depth=self.settings.max_depth)

    def _bouncing(self, plain: Settings) -> float:
        """Seconds of those, predicted."""
        return self.estimate.seconds(self._whole_of(plain)) - self.estimate.seconds(plain)

    def _with_bounces(self, best: Trial, look: Look) -> tuple[Trial, Look]:
        """`best` and its `look`, as well as the truth, with the further bounces that they lack, of the method chosen:
        its error is a small part of a small part of the light."""
        whole = self._looked(self._whole_of(look.composition.settings))
        self.trials[-1] = best = replace(best, seconds=self._price(whole))
        self.known = False
        self.truth = replace(self.truth, radiance=self.truth.radiance + whole.radiance - look.radiance)
        return best, whole

    def _as_named(self, plain: Settings) -> tuple[Trial, Look]:
        return self._judged(look := self._looked_at(plain), True, "named"), look

    def _for_all_lights(self, plain: Settings) -> tuple[Trial, Look]:
        """The cheapest that keeps to the error, of what no light needs for itself: fewer lights may do for any method,
        are looked for afterwards, and want fewer maps."""
        march = plain.but(visibility="raymarch")
        full = self.estimate.seconds(self._whole_of(march))
        found = self._cheaper(Trial("raymarch", full), self._candidates(plain, True), self._looked_at, self._bouncing)
        if found:
            return found
        if self.truth.composition.settings != march:
            self.truth, self._others = self._looked(march), None
        self._reckon()
        why = "nothing that serves all lights is cheaper and keeps to max_error"
        return self._tried(march, self._price(self.truth) + self._bouncing(march), 0.0, True, why), self.truth

    def _cheaper(self, best: Trial, candidates: list[Settings], looked: Callable[[Settings], Look],
                 more: Callable[[Settings], float]) -> tuple[Trial, Look] | None:
        """The first of `candidates`, by price, that keeps to the error and is cheaper than `best`; None: none is.
        `more`: seconds of what is not looked at."""
        found = [(self.estimate.seconds(s) + more(s), s) for s in candidates]
        for seconds, candidate in sorted(found, key=lambda pair: pair[0]):
            hopeless = self._hopeless(candidate)
            if hopeless or not self._pays(best.seconds - seconds, TRIAL + self._in_vain(candidate)):
                self._tried(candidate, seconds, why="usually off by more than max_error allows" if hopeless else
                            "saves less than a trial takes")
                continue
            tried = looked(candidate)
            tried = self._closer(tried, best.seconds - self._price(tried) - more(candidate))
            good = self._error(tried) <= self._most
            if good and len(tried.composition.runs) == 1 and self._price(tried) + more(candidate) < best.seconds:
                return self._judged(tried, True, "the cheapest that keeps to max_error"), tried
            self._judged(tried, False, "no cheaper" if good else TOO_FAR)
        return None

    def _in_vain(self, settings: Settings) -> float:
        """Seconds of what is built for a trial, which may come to nothing: maps of lights keep to a limit half of the
        time, an atlas two times of three."""
        built = self._served(settings) * self.estimate.built(settings)
        return built / 2 if REGISTRY[settings.visibility].per_field else built

    def _hopeless(self, settings: Settings) -> bool:
        return estimate.one_logistic(settings) and estimate.usual_error(settings) > HOPELESS * self._most

    def _looked_at(self, settings: Settings) -> Look:
        """By a method of which a look costs little: the truth has all lights from then on."""
        look = self._looked(settings)
        self._with_all_lights(look)
        return look

    @staticmethod
    def _candidates(settings: Settings, of_all: bool) -> list[Settings]:
        """Return what ``auto`` may choose in place of the march, with the settings' own dials and finer ones.

        `of_all`: methods that are built for all lights together, else for each light.
        """
        found = []
        for name, method in REGISTRY.items():
            if method.automatic and name != "raymarch" and method.per_field == of_all:
                found.append(settings.but(visibility=name))
                if set(FINER) <= set(method.dials):
                    finer = {dial: max(value, getattr(settings, dial)) for dial, value in FINER.items()}
                    found.append(settings.but(visibility=name, **finer))
        return found

    def _without(self, best: Trial, look: Look, omissions: dict, limit: float) -> tuple[Trial, Look]:
        """Like `best`, without what the picture hardly shows, by `limit`."""
        for name, of in omissions.items():
            kept = [(best, look)]
            while (settings := of(look.composition.settings, look.composition)) is not None:
                saved, anew = self._saved(settings, best, look)
                foreseen = self._errors.get(settings, halved([t.error for t, _ in kept]) if name in LIGHTS else 0.0)
                if saved < SAVING * best.seconds or not self._pays(saved, LEFT_OUT + anew) or foreseen > limit:
                    break
                tried = self._closer(self._looked(settings), saved)
                good = self._error(tried) <= limit
                cheaper = self._price(tried) < best.seconds
                why = (f"kept: it is off by more than {limit:.2%}" if not good else
                       "left out: the picture keeps to max_error" if cheaper else "kept: it costs nothing")
                trial = self._judged(tried, good and cheaper, why, name)
                if not trial.taken:
                    break
                best, look = trial, tried
                kept.append((best, look))
            if name in LIGHTS:
                best, look = self._without_glints(kept, limit)
        return best, look

    def _without_glints(self, kept: list[tuple[Trial, Look]], limit: float) -> tuple[Trial, Look]:
        """The last of `kept`, each of fewer lights than the one before, that glints no more than `limit` allows."""
        for best, look in reversed(kept[1:]):
            settings = look.composition.settings
            error = self._glints.error(settings, self._spp)
            if error <= limit:
                return best, look
            self._errors[settings] = error
            self.trials[self.trials.index(best)] = replace(
                best, error=error, taken=False, why="kept: fewer lights would glint")
        return kept[0]

    def _by_time(self) -> Choice:
        """The smallest error when the time is over: samples that a march cannot have may be worth a bias."""
        march = self.settings.but(visibility="raymarch")
        samples = SAMPLES * probed(self._size[0] * self._size[1])
        if max(self.estimate.each(march) * samples, LOOK) > SPARED * self._left():
            return self._untried(march)
        self._marched(march)
        best, least = self.truth, self._ends_at(self.truth)
        self._tried(march, self._price(best), least, True, "smallest error when the time is over")
        # What is built fast goes first: what it finds spares the others.
        both = [s for of_all in (True, False) for s in self._candidates(self.settings, of_all)]
        for settings in sorted(both, key=self.estimate.built):
            left, taken = self._left(), self.estimate.built(settings) + LOOK
            samples = (left - taken) / max(self.estimate.each(settings), 1e-9)
            hoped = math.hypot(estimate.usual_error(settings), self._noise(samples))
            late = best.each > left  # not even one sample of it fits: whatever is faster
            most = (RISKED if hoped < WORTH * least else SPARED) * left
            if self.estimate.each(settings) > best.each if late else hoped > least or taken > most:
                continue
            look = self._looked(settings)
            error = self._ends_at(look)
            better = error < least and len(look.composition.runs) == 1
            self._tried(settings, self._price(look), error, better,
                        "smallest error when the time is over" if better else "a larger error when the time is over")
            best, least = (look, error) if better else (best, least)
        self._warn(best.each, best.composition.settings)
        return Choice(best.composition, self.trials, {"seconds": self.limits.seconds, "error": least})

    def _untried(self, march: Settings) -> Choice:
        """By the prices alone: the march, which has no error of its own, if the samples that the scene asks for fit
        into half of the time; else the cheapest."""
        fits = self.estimate.seconds(march) < 0.5 * self._left()
        settings = march if fits else self.settings.but(visibility=self.estimate.effects.visibility)
        self._warn(self.estimate.each(settings), settings)
        return Choice(self._composed(settings), predicted={"seconds": self.limits.seconds, "error": math.nan})

    def _ends_at(self, look: Look) -> float:
        """Error of a picture by what is left of the time."""
        samples = self._left() / max(look.each, 1e-9)
        return math.hypot(self.probes.error(look, self.truth, max(samples, 1.0)), self._noise(samples))

    def _noise(self, samples: float) -> float:
        """Return the noise of so many samples; fewer than one tell methods apart that there is no time for."""
        return self.probes.noise(self.truth) / math.sqrt(max(samples, 1e-3))

    def _left(self) -> float:
        return max(self.limits.seconds - self._gone(), 1e-3)

    def _warn(self, each: float, settings: Settings) -> None:
        """Warn before a render that cannot end in time."""
        if each > self._left():
            mi.Log(  # type: ignore[operator]  # an object in the stub
                mi.LogLevel.Warn,
                f"nrf integrator: time_budget is {self.limits.seconds:.3g} s, but one sample a pixel takes about "
                f"{each:.3g} s by {settings.visibility}; that will be rendered")
