"""What a picture may do without, if it hardly shows: each in steps, from the next of which settings are returned, None
where there is none."""

import math
from collections.abc import Callable

from ..scene import effects
from ..scene.settings import Settings
from .composition import Composition

FEWEST = 32
"""Lights that stand for an environment at least."""
DIM = 0.005
"""Share of all light that the dimmest may have at first."""
SMALL = 0.01
"""Share of the picture that bounds of a field are below which may be left out."""


def _no_bounces(settings: Settings, composition: Composition) -> Settings | None:
    return settings.but(max_depth=2) if composition.effects.bounces else None


def _half_of_the_lights(settings: Settings, composition: Composition) -> Settings | None:
    """Not a quarter: what that saves is a sixth of the time, and by chance the probes may find it good (`knot`: 1.7 %
    where it is 2.2 %)."""
    most = max((d.shining for d in composition.lights.discrete), default=0)
    return settings.but(environment_lights=most // 2) if most > FEWEST else None


def _bright_lights(settings: Settings, composition: Composition) -> Settings | None:
    """Environments have their own way: their lights are of about equal power."""
    share, lights = max(2 * settings.dimmest, DIM), composition.lights
    if any(d.shining for d in lights.discrete) or lights.brighter(share) == len(lights.rows.power):
        return None
    return settings.but(dimmest=share)


def _no_small_field(settings: Settings, composition: Composition) -> Settings | None:
    sizes = []
    for number, medium in enumerate(composition.media):
        box = effects.on_film(composition.sensor, medium.frame)
        if box is not None:
            sizes.append((float((box[1] - box[0]).prod()), number))
    if len(composition.media) < 2 or not sizes or min(sizes)[0] > SMALL:
        return None
    there = [i for i in range(len(composition.media) + len(settings.without)) if i not in settings.without]
    return settings.but(without=(*settings.without, there[min(sizes)[1]]))


def _no_lobes(settings: Settings, composition: Composition) -> Settings | None:
    return settings.but(specular=False) if composition.effects.specular else None


def halved(errors: list[float]) -> float:
    """The least error to expect of half the lights, after those of all, of half of them, and so on: what each step adds
    to its square is twice what the one before added, where lights err independently of each other, more elsewhere
    (environments: 2.8 to 4.5 times, `statue`, `knot`)."""
    return math.sqrt(max(3 * errors[-1]**2 - 2 * errors[-2]**2, 0.0)) if len(errors) > 1 else 0.0


Omission = Callable[[Settings, Composition], Settings | None]
LIGHTS: dict[str, Omission] = {
    "half of the environment's lights": _half_of_the_lights,
    "dim lights": _bright_lights}
OMISSIONS: dict[str, Omission] = {
    "further bounces": _no_bounces, "small fields": _no_small_field, **LIGHTS, "specular lobes": _no_lobes}
"""What may be left out, in the order in which it is tried."""
