"""Candidates of a pilot: ways to render a picture in less time, in the order in which they are tried.

The pilot tries other visibility methods in place of the march. It then leaves out effects that hardly change the
picture, one after the other, each as often as the error allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...infer.visibility import REGISTRY
from ..maps import building
from ..scene.many import Crowd
from ..scene.settings import Settings
from . import effects
from .composition import Composition


def methods(march: Composition) -> list[tuple[Settings, int]]:
    """Return the settings of methods that may replace the `march`, and the number of rays that fill their tables.

    Maps that do not fit into `map_memory` at once are left out, since every pass would build them anew. So are those of
    many instances, each of which would need maps of its own.
    """
    media, table, candidates = march.media, march.lights.table(march.media[0].frame), []
    for method in (m for m in REGISTRY.values() if m.automatic and m.name != "raymarch"):
        for components in (1, 2) if "map_components" in method.dials else (march.settings.map_components,):
            settings = replace(march.settings, visibility=method.name, map_components=components)
            size = table.count * sum(building.size_per_light(method.name, m, table, settings) for m in media)
            rays = len(media) * method.rays(table.count, settings.map_resolution)
            fits = 0 < size <= settings.map_memory * 2**20 and not any(isinstance(m, Crowd) for m in media)
            if method.per_field or fits:
                candidates.append((settings, rays if method.per_field else rays * components))
    return sorted(candidates, key=lambda candidate: candidate[1])


def name(settings: Settings, original: Settings) -> str:
    """Return the method in words, with its parameters and what it leaves out of the picture by `original` settings."""
    per_light = bool(REGISTRY[settings.visibility].sampled)
    details = {
        f" of {settings.map_resolution}²": per_light,
        ", two logistics": per_light and settings.map_components == 2,
        ", without further bounces": settings.max_depth != original.max_depth,
        f", without {len(settings.without_media)} of the fields": bool(settings.without_media),
        f", {settings.environment_lights} lights of the environment":
            settings.environment_lights < original.environment_lights,
        f", {settings.brightest_lights} brightest lights": bool(settings.brightest_lights),
        ", without specular lobes": original.specular and not settings.specular,
    }
    return settings.visibility + "".join(text for text, applies in details.items() if applies)


def is_complete(settings: Settings, march: Settings) -> bool:
    """Return True if `settings` leave nothing out of the picture by `march`."""
    return replace(settings, visibility=march.visibility, map_components=march.map_components) == march


def _no_bounces(now: Composition) -> Settings | None:
    return replace(now.settings, max_depth=2) if now.effects.bounces else None


def _no_smallest_field(now: Composition) -> Settings | None:
    boxes = [effects.on_film(now.sensor, m.frame) for m in now.media]
    sizes = [np.inf if box is None else float(np.prod(box[1] - box[0])) for box in boxes]
    if len(sizes) < 2 or min(sizes) == np.inf or any(isinstance(m, Crowd) for m in now.media):
        return None
    absent = now.settings.without_media
    numbers = [i for i in range(len(sizes) + len(absent)) if i not in absent]
    return replace(now.settings, without_media=(*absent, numbers[int(np.argmin(sizes))]))


def _half_of_the_lights(now: Composition) -> Settings | None:
    """Halve the lights of environments, which have about equal power; without any, leave out the dimmer half."""
    cells, lights = max((d.shining for d in now.lights.discrete), default=0), len(now.lights.rows.power)
    if cells:
        return replace(now.settings, environment_lights=cells // 2) if cells > 1 else None
    return replace(now.settings, brightest_lights=lights // 2) if lights > 1 else None


def _no_lobes(now: Composition) -> Settings | None:
    return replace(now.settings, specular=False) if now.effects.specular else None


OMISSIONS: tuple[Callable[[Composition], Settings | None], ...] = (
    _no_bounces, _no_smallest_field, _half_of_the_lights, _no_lobes)
"""Functions of a composition that return settings which leave out one effect more; None if it is absent."""
