"""Settings that a picture may be rendered with, tried on some of its pixels: what each takes, and how far off it is."""

import math

from ...infer.visibility import REGISTRY
from ..scene.settings import Limits, Settings
from .choice import Trial
from .composition import Composition
from .estimate import Estimate
from .probing import SAMPLES, Look, Probes, probed

PART, MANY = 0.005, 4
"""Of the samples of all frames, what the probes may be, up to so many times those of one picture: fewer of them leave
more room for chance, and good methods are then refused."""
UNTOLD = 32
"""Samples a pixel that a render is taken to have if a limit of noise says how many."""


class Trials:
    """For one render of `scene` by `settings` and `limits`, with `spp` samples a pixel unless a limit says how many.

    trials    what was tried, in order
    estimate  of seconds, before anything is tried; `probes`: the pixels that are looked at, from :meth:`_marched` on
    """

    estimate: Estimate
    probes: Probes

    def __init__(self, scene, settings: Settings, limits: Limits, sensor, spp: int, patches):
        self.scene, self.settings, self.limits, self.sensor, self.patches = scene, settings, limits, sensor, patches
        self._spp = UNTOLD if limits.noise > 0 else spp
        self._size = tuple(int(n) for n in sensor.film().crop_size())
        self.trials: list[Trial] = []
        self._errors: dict[Settings, float] = {}

    def _composed(self, settings: Settings) -> Composition:
        return Composition(self.scene, settings, self.sensor, self._spp, self.patches)

    def _looked(self, settings: Settings) -> Look:
        look = self.probes.look(lambda: self._composed(settings))
        self.patches = look.composition.patches  # where light bounces between is the same for all of them
        return look

    def _marched(self, march: Settings) -> Look:
        """The probes by the march, which also tell how far off the prices are."""
        pixels = self._size[0] * self._size[1]
        few, worth = probed(pixels) * pixels, PART * pixels * self._spp * self.settings.frames / SAMPLES
        self.probes = Probes(self.sensor, self.estimate.media, round(min(max(few, worth), MANY * few)))
        truth = self._looked(march)
        self.estimate.dearer = self._price(truth) / max(self.estimate.seconds(march), 1e-9)
        return truth

    def _price(self, look: Look) -> float:
        """Seconds of a picture, what is built shared among the frames that it serves."""
        return look.built / self._served(look.composition.settings) + look.each * self._spp

    def _served(self, settings: Settings) -> int:
        """Frames that share what is built."""
        return self.settings.frames if self.settings.still or REGISTRY[settings.visibility].per_field else 1

    def _judged(self, look: Look, truth: Look, taken: bool, why: str, what: str = "") -> Trial:
        error = self.probes.error(look, truth, self._spp)
        self._errors[look.composition.settings] = error
        return self._tried(look.composition.settings, self._price(look), error, taken, why, what)

    def _tried(self, settings: Settings, seconds: float, error: float = math.nan, taken: bool = False, why: str = "",
               what: str = "") -> Trial:
        dials = [f"{settings.map_resolution}², {settings.map_components} logistics"] if REGISTRY[
            settings.visibility].drawn else []
        name = " ".join([settings.visibility, *dials, *([f"without {what}"] if what else [])])
        self.trials.append(Trial(name, seconds, error, taken, why))
        return self.trials[-1]
