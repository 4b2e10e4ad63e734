"""Seconds of a whole picture by other settings than those asked for, before anything is built."""

from dataclasses import replace

from ..cost import model
from ..lights import scene_lights
from ..scene import effects
from ..scene.media import find_media
from ..scene.settings import Settings


class Estimate:
    """By the prices of :mod:`mi_ntf.render.cost.model`, for a picture of so many `pixels` and `spp` samples of each.

    dearer  seconds of this scene on this machine over those of the prices; 1 until it is known
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
        """Of maps and atlases alone."""
        prices = model.constants()
        return self.dearer * 1e-9 * sum(model.shared(work, prices) for work in self._works(settings))

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
