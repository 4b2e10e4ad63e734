"""Seconds and error of a whole picture by other settings than those asked for, before anything is built."""

from dataclasses import replace

from ...infer.visibility import REGISTRY
from ..cost import model
from ..lights import scene_lights
from ..scene import effects
from ..scene.media import find_media
from ..scene.settings import Settings

ONE_LOGISTIC, USUAL = 0.035, 0.017
"""Relative RMSE, as far as it can be foreseen: of maps with one logistic, and of atlases and maps with two (medians of
the shipped scenes under points, environments and skies: 1.7 to 12.8 %, 0.6 to 9.7 %)."""


def one_logistic(settings: Settings) -> bool:
    """Whether those are maps of one."""
    return not REGISTRY[settings.visibility].per_field and settings.map_components == 1


def usual_error(settings: Settings) -> float:
    """Of such a method, relative RMSE."""
    return ONE_LOGISTIC if one_logistic(settings) else USUAL


class Estimate:
    """By the prices of :mod:`mi_ntf.render.cost.model`, for a picture of so many `pixels` and `spp` samples of each.

    dearer  seconds of a sample of this scene on this machine over those of the prices; 1 until it is known
    """

    def __init__(self, scene, settings: Settings, sensor, pixels: int, spp: int):
        self._settings, self._rays, self.spp = settings, pixels * spp, spp
        self.media = find_media(scene)
        self.lights = scene_lights.Lights(scene, self.media, settings.light_samples, settings.environment_lights)
        self.effects = effects.describe(scene, settings, sensor, spp, self.media, self.lights)
        self.dearer = 1.0

    def seconds(self, settings: Settings) -> float:
        """What is built for a field shared among the frames."""
        return self.built(settings) + self.spp * self.each(settings)

    def built(self, settings: Settings) -> float:
        """Of maps and atlases alone. They do not depend on the picture, so `dearer` says nothing of them: smoke makes
        samples 8 times as dear as the prices tell."""
        prices = model.constants()
        return 1e-9 * sum(model.shared(work, prices) for work in self._works(settings))

    def each(self, settings: Settings) -> float:
        """Of one sample for every pixel."""
        prices = model.constants()
        stages = [model.seconds(work, prices) | {"maps or volumes": 0.0} for work in self._works(settings)]
        return self.dearer * sum(sum(s.values()) for s in stages) / self.spp

    def _works(self, settings: Settings) -> list[model.Work]:
        found, works = self.effects, []
        bounces = found.bounces if settings.max_depth != 2 else ""
        for number, (medium, seen) in enumerate(zip(self.media, found.in_view, strict=True)):
            if number in settings.without:
                continue
            others = effects.others(settings, self._rays, found.surfaces, bounces) if found.lit else 0
            work = model.work(settings, medium, settings.visibility, self._rays if seen else 0,
                              self._count(settings), effects.drawn(settings, self.lights), others)
            patches = model.patches(medium.field.grid) if bounces == "radiosity" else 0
            works.append(replace(work, patches=patches, still=settings.still))
        return works

    def _count(self, settings: Settings) -> int:
        """Lights of the table."""
        count = self.lights.brighter(settings.dimmest)
        if settings.environment_lights < self._settings.environment_lights:
            count += sum(min(settings.environment_lights, d.shining) - d.shining for d in self.lights.discrete)
        return count
