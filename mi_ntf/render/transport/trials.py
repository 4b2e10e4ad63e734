"""Settings that a picture may be rendered with, tried on some of its pixels: what each takes, and how far off it is."""

import math
from dataclasses import replace

from ...infer.visibility import REGISTRY
from ..scene.settings import Limits, Settings
from .choice import Trial
from .composition import Composition
from .estimate import Estimate
from .probing import CAUTION, SAMPLES, Look, Probes, probed

CLOSER = 4
"""Times as many pixels are looked at where that costs nothing or chance may have refused a method: of `globe` by an
atlas, which errs by 1.70 %, 1000 pixels tell 1.74 ± 0.25, 4000 of others 1.80 ± 0.26."""
BRIEF = 0.05
"""Seconds, less than which a look takes as long as its kernels need to begin, not what they compute."""
UNTOLD = 32
"""Samples a pixel that a render is taken to have if a limit of noise says how many."""


class Trials:
    """For one render of `scene` by `settings` and `limits`, with `spp` samples a pixel unless a limit says how many.

    trials    what was tried, in order
    estimate  of seconds, before anything is tried
    probes    the pixels that are looked at, from :meth:`_marched` on; `truth`: by the march, what they show
    """

    estimate: Estimate
    probes: Probes
    truth: Look

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

    def _more_pixels(self) -> None:
        """From now on, and of the truth."""
        self.probes = Probes(self.sensor, self.estimate.media, CLOSER * self.probes.count)
        self.truth = self._again(self.truth)

    def _again(self, look: Look) -> Look:
        """What `look` is of through the probes of today."""
        return replace(self.probes.look(lambda: look.composition), built=look.built)

    def _marched(self, march: Settings) -> None:
        """The probes by the march, which also tell how far off the prices are."""
        pixels = math.prod(self._size)
        self.probes = Probes(self.sensor, self.estimate.media, round(probed(pixels) * pixels))
        self.truth = self._looked(march)
        if self.truth.each * self.probes.count * SAMPLES / pixels < BRIEF:
            self._more_pixels()
        self.estimate.dearer = self._price(self.truth) / max(self.estimate.seconds(march), 1e-9)

    def _price(self, look: Look) -> float:
        """Seconds of a picture, what is built shared among the frames that it serves."""
        return look.built / self._served(look.composition.settings) + look.each * self._spp

    def _served(self, settings: Settings) -> int:
        """Frames that share what is built."""
        return self.settings.frames if self.settings.still or REGISTRY[settings.visibility].per_field else 1

    def _error(self, look: Look, caution: float = CAUTION) -> float:
        return self.probes.error(look, self.truth, self._spp, caution)

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
