"""Ways to render a picture for less, in the order in which a pilot tries them.

The pilot tries other visibility methods in place of the march. With the method that it takes, it then leaves out
effects that the picture hardly shows, one after the other, and each as often as the error allows.
"""

from collections.abc import Callable, Iterator

import numpy as np

from ...infer.visibility import REGISTRY
from ..maps import building
from ..scene import effects
from ..scene.settings import Settings
from .composition import Composition


def methods(march: Composition) -> Iterator[tuple[Settings, int]]:
    """Yield ``(settings, rays)`` of what may take the place of the `march`.

    `rays` fill what the method holds. Maps that do not fit into `map_memory` at once are left out, since every pass
    would build them anew, and so are maps of no light.
    """
    ways = [march.settings.but(visibility=method.name, map_components=logistics) for method in REGISTRY.values()
            if method.automatic and method.name != "raymarch"
            for logistics in ((1, 2) if "map_components" in method.dials else (march.settings.map_components,))]
    for settings in sorted(ways, key=lambda s: _rays(march, s)):
        if per_field(settings) or _fits(march, settings):
            yield settings, _rays(march, settings)


def name(settings: Settings, whole: Settings) -> str:
    """Return in words a method, its dials, and what it leaves out of the picture that `whole` asks for."""
    drawn = bool(REGISTRY[settings.visibility].drawn)
    less = {
        f" of {settings.map_resolution}²": drawn,
        ", two logistics": drawn and settings.map_components == 2,
        ", without further bounces": settings.max_depth != whole.max_depth,
        f", without {len(settings.without)} of the fields": bool(settings.without),
        f", {settings.environment_lights} lights of the environment":
            settings.environment_lights < whole.environment_lights,
        f", {settings.brightest} brightest lights": bool(settings.brightest),
        ", without specular lobes": whole.specular and not settings.specular,
    }
    return settings.visibility + "".join(words for words, there in less.items() if there)


def per_field(settings: Settings) -> bool:
    """Return True if what the method holds serves all lights of a field."""
    return REGISTRY[settings.visibility].per_field


def _rays(march: Composition, settings: Settings) -> int:
    rays = REGISTRY[settings.visibility].rays(len(march.lights.rows.power), settings.map_resolution)
    return len(march.media) * rays * (1 if per_field(settings) else settings.map_components)


def _fits(march: Composition, settings: Settings) -> bool:
    table, options = march.lights.table(march.media[0].frame), building.options(settings)
    size = table.count * sum(building.size_per_light(settings.visibility, m, table, options) for m in march.media)
    return 0 < size <= options.map_memory * 2**20


def _no_bounces(now: Composition) -> Settings | None:
    return now.settings.but(max_depth=2) if now.effects.bounces else None


def _no_smallest_field(now: Composition) -> Settings | None:
    boxes = [effects.on_film(now.sensor, m.frame) for m in now.media]
    sizes = [np.inf if box is None else float(np.prod(box[1] - box[0])) for box in boxes]
    if len(sizes) < 2 or min(sizes) == np.inf:
        return None
    numbers = [i for i in range(len(sizes) + len(now.settings.without)) if i not in now.settings.without]
    return now.settings.but(without=(*now.settings.without, numbers[int(np.argmin(sizes))]))


def _half_of_an_environment(now: Composition) -> Settings | None:
    most = max((light.shining for light in now.lights.discrete), default=0)
    return now.settings.but(environment_lights=most // 2) if most > 1 else None


def _dimmer_half(now: Composition) -> Settings | None:
    """Environments are none of these: their lights are of about equal power, and have a way of their own."""
    if len(now.lights.rows.power) < 2 or any(light.shining for light in now.lights.discrete):
        return None
    return now.settings.but(brightest=len(now.lights.rows.power) // 2)


def _no_lobes(now: Composition) -> Settings | None:
    return now.settings.but(specular=False) if now.effects.specular else None


OMISSIONS: tuple[Callable[[Composition], Settings | None], ...] = (
    _no_bounces, _no_smallest_field, _half_of_an_environment, _dimmer_half, _no_lobes)
"""Functions of a composition that return settings which leave something out; None if there is nothing."""
