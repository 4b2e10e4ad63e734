"""``visibility=auto`` under a limit: which method, with which dials, and what is not worth its price.

Some pixels are rendered beforehand by the march and by what is cheaper: the difference is the error that a picture
would have. The cheapest that keeps to `max_error` renders the picture.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...infer.visibility import REGISTRY
from ..cost import model
from ..scene import effects
from ..scene.settings import Limits, Settings
from . import camera_light
from .composition import Composition

SHARE = 0.03
"""Of the pixels, those rendered beforehand, at most `MOST` and at least `LEAST`; `SAMPLES` of each, or fewer if the
picture has fewer."""
MOST, LEAST, SAMPLES = 1024, 192, 4
MARGIN = 0.9
"""Of `max_error`, what the pixels rendered beforehand may be off: they are few."""
TRIAL = 1.0
"""Seconds that a trial takes, compilation mostly: what saves less is not tried."""
SAVING = 0.1
"""Of the predicted time, what leaving something out must save at least."""
FINER = {"map_resolution": 256, "map_components": 2}
"""Dials of a map for smaller errors."""
FEWEST = 32
"""Lights that stand for an environment at least."""
UNTOLD = 32
"""Samples a pixel that a render is taken to have if a limit of noise says how many."""


@dataclass(frozen=True)
class Trial:
    """Something in place of the march of all that the scene calls for: `name`, its `error` (relative RMSE; nan: not
    measured) and `seconds` predicted, whether it is `taken`, and why."""

    name: str
    settings: Settings
    seconds: float
    error: float = float("nan")
    taken: bool = False
    why: str = ""


@dataclass
class Choice:
    """`composition`: to render with; `trials`: what was looked at, in order; `predicted`: seconds, error."""

    composition: Composition
    trials: list = field(default_factory=list)
    predicted: dict = field(default_factory=dict)

    @property
    def effects(self) -> effects.Effects:
        """Those of the composition, with what the trials say for its method."""
        found, taken = self.composition.effects, [t for t in self.trials if t.taken]
        return replace(found, reason=taken[-1].why) if taken else found

    def told(self) -> dict:
        """``predicted`` and ``trials`` as numbers and words."""
        names = ("name", "seconds", "error", "taken", "why")
        return {"predicted": self.predicted,
                "trials": [{name: getattr(t, name) for name in names} for t in self.trials]}


class Chooser:
    """For one render of `scene` by `settings` and `limits`, with `spp` samples a pixel unless a limit says how many."""

    def __init__(self, scene, settings: Settings, limits: Limits, sensor, spp: int, patches):
        self.scene, self.settings, self.limits, self.sensor, self.patches = scene, settings, limits, sensor, patches
        self.spp = UNTOLD if limits.noise > 0 else spp
        width, height = (int(n) for n in sensor.film().crop_size())
        self._pixels = width * height
        self.trials: list[Trial] = []

    def choose(self) -> Choice:
        """As the limits say. A method that the user named stays, whatever its error."""
        plain = self._composed(self.settings)
        found = plain.effects
        if found.gradients or not found.needs_visibility or found.visibility == "none":
            return Choice(plain)
        if self.limits.error > 0:
            return self._by_error(plain)
        if self.limits.seconds > 0 and self.settings.visibility == "auto":
            return self._by_time(plain)
        return Choice(plain)

    def _composed(self, settings: Settings) -> Composition:
        return Composition(self.scene, settings, self.sensor, self.spp, self.patches)

    def _by_time(self, plain: Composition) -> Choice:
        """Of what fits into the time with the samples that the scene asks for, the march, which has no error of its
        own; else the cheapest."""
        march = self.settings.but(visibility="raymarch")
        seconds = self._seconds(plain, march)
        if plain.effects.visibility != "raymarch" and seconds < 0.5 * self.limits.seconds:
            return Choice(self._composed(march), predicted={"seconds": seconds, "error": 0.0})
        least = self._seconds(plain, plain.settings.but(visibility=plain.effects.visibility)) / max(self.spp, 1)
        if least > self.limits.seconds:
            mi.Log(  # type: ignore[operator]  # an object in the stub
                mi.LogLevel.Warn,
                f"nrf integrator: time_budget is {self.limits.seconds:.3g} s, but one sample a pixel takes about "
                f"{least:.3g} s by {plain.effects.visibility}; that will be rendered")
        return Choice(plain)

    def _by_error(self, plain: Composition) -> Choice:
        march = self._composed(self.settings.but(visibility="raymarch"))
        probes = Probes(self.sensor, self._pixels, min(self.spp, SAMPLES))
        truth = probes.of(march)
        best = self._method(plain, march, probes, truth)
        best = self._without(plain, probes, truth, best)
        trial, composition = best
        return Choice(composition, self.trials, {"seconds": trial.seconds, "error": trial.error})

    def _method(self, plain: Composition, march: Composition, probes: "Probes", truth):
        """``(trial, composition)`` of the cheapest method that keeps to the error."""
        if self.settings.visibility != "auto":
            error = relative(probes.of(plain), truth)
            return self._tried(plain.settings, self._seconds(plain, plain.settings), error, True, "named"), plain
        full = self._seconds(plain, march.settings)
        for seconds, settings in sorted(((self._seconds(plain, s), s) for s in self._candidates()), key=lambda p: p[0]):
            if seconds > full - TRIAL:
                self._tried(settings, seconds, why="saves less than a trial takes")
                continue
            tried = self._composed(settings)
            if len(tried.runs) > 1:
                self._tried(settings, seconds, why="its maps do not fit into map_memory at once")
                continue
            error = relative(probes.of(tried), truth)
            if error <= MARGIN * self.limits.error:
                return self._tried(settings, seconds, error, True, "the cheapest that keeps to max_error"), tried
            self._tried(settings, seconds, error, why="off by more than max_error allows")
        return self._tried(march.settings, full, 0.0, True, "nothing cheaper keeps to max_error"), march

    def _candidates(self) -> list[Settings]:
        """What ``auto`` may choose, with the settings' own dials and finer ones."""
        found = []
        for name, method in REGISTRY.items():
            if method.automatic and name != "raymarch":
                found.append(self.settings.but(visibility=name))
                if set(FINER) <= set(method.dials):
                    found.append(self.settings.but(visibility=name, **FINER))
        return found

    def _without(self, plain: Composition, probes: "Probes", truth, best):
        """``(trial, composition)`` like `best`, without what the picture hardly shows."""
        for name, of in OMISSIONS.items():
            good = True
            while good:
                trial, composition = best
                settings = of(composition.settings, composition)
                seconds = self._seconds(plain, settings) if settings else trial.seconds
                if trial.seconds - seconds < max(SAVING * trial.seconds, TRIAL):
                    break
                tried = self._composed(settings)
                error = relative(probes.of(tried), truth)
                good = error <= MARGIN * self.limits.error
                why = "left out: the picture keeps to max_error" if good else "kept: it is more than max_error allows"
                if good:
                    best = self._tried(settings, seconds, error, True, why, name), tried
                else:
                    self._tried(settings, seconds, error, False, why, name)
        return best

    def _tried(self, settings, seconds, error=float("nan"), taken=False, why="", what="") -> Trial:
        dials = [f"{settings.map_resolution}², {settings.map_components} logistics"] if REGISTRY[
            settings.visibility].drawn else []
        name = " ".join([settings.visibility, *dials, *([f"without {what}"] if what else [])])
        self.trials.append(Trial(name, settings, seconds, error, taken, why))
        return self.trials[-1]

    def _seconds(self, plain: Composition, settings: Settings) -> float:
        """Predicted, of the whole render."""
        found, light = plain.effects, plain.lights
        rays = self._pixels * self.spp
        count = len(light.rows.power)
        if settings.environment_lights < self.settings.environment_lights:
            count += sum(min(settings.environment_lights, d.shining) - d.shining for d in light.discrete)
        bounces = found.bounces if settings.max_depth != 2 else ""
        total = 0.0
        for medium, seen in zip(plain.media, found.in_view, strict=True):
            others = effects.others(settings, rays, found.surfaces, bounces) if found.lit else 0
            work = model.work(settings, medium, settings.visibility, rays if seen else 0, count,
                              effects.drawn(settings, light), others)
            work = replace(work, patches=model.patches(medium.field.grid) if bounces == "radiosity" else 0)
            total += sum(model.seconds(work, model.constants()).values())
        return total


def _fewer_lights(settings: Settings, composition: Composition) -> Settings | None:
    most = max((d.shining for d in composition.lights.discrete), default=0)
    return settings.but(environment_lights=most // 2) if most > FEWEST else None


def _no_bounces(settings: Settings, composition: Composition) -> Settings | None:
    return settings.but(max_depth=2) if composition.effects.bounces else None


def _no_lobes(settings: Settings, composition: Composition) -> Settings | None:
    return settings.but(specular=False) if composition.effects.specular else None


OMISSIONS: dict[str, Any] = {
    "further bounces": _no_bounces, "half of the environment's lights": _fewer_lights, "specular lobes": _no_lobes}
"""What may be left out → settings without it, None where there is nothing to leave out."""


class Probes:
    """Camera rays through pixels here and there."""

    def __init__(self, sensor, pixels: int, samples: int):
        self.count, self.samples = int(min(max(SHARE * pixels, LEAST), MOST)), samples
        rng = np.random.default_rng(0)
        width, height = sensor.film().crop_size()
        place = np.repeat(rng.random((2, self.count)), samples, 1)
        n = place.shape[1]
        place += (rng.random((2, n)) - 0.5) / np.array([[width], [height]])
        aperture = mi.Point2f(*(mi.Float(v) for v in rng.random((2, n))))
        moment = mi.Float(rng.random(n) * float(sensor.shutter_open_time()) + float(sensor.shutter_open()))
        at = mi.Point2f(*(mi.Float(v) for v in place))
        ray, weight = sensor.sample_ray_differential(moment, 0.0, at, aperture)
        self._ray, self._weight = mi.Ray3f(ray), weight
        if dr.width(self._ray) < n:  # a sensor whose rays are all the same
            self._ray = dr.gather(mi.Ray3f, self._ray, dr.zeros(mi.UInt32, n))
        self._quadrature = tuple(mi.Float(v) for v in rng.random((2, n)))
        dr.eval(self._ray, self._weight, self._quadrature)

    def of(self, composition: Composition) -> np.ndarray:
        """(pixels, 3) radiance."""
        total = mi.Color3f(0)
        for run in range(len(composition.runs)):
            composition.select(run)
            with composition.lights.bare():
                light, _ = camera_light.trace(composition, self._ray, self._quadrature, dr.opaque(mi.UInt32, 7))
            total += light * self._weight
        return np.array(total).T.reshape(self.count, self.samples, 3).mean(1)


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    """Relative RMSE; 0 for a black truth."""
    power = float((truth**2).mean())
    return float(np.sqrt(((found - truth) ** 2).mean() / power)) if power > 0 else 0.0
