"""What can be varied: a :class:`Point` is one way to render the scene; a neighbour differs by one turn of one dial.
"""

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from ...infer.visibility import REGISTRY

STOCK = "volpath"
"""Mitsuba's own path tracer, which renders the same scene; a method of its own here."""


@dataclass(frozen=True)
class Point:
    """One way to render the scene. `method`: of the registry, or ``volpath``; the others are properties of the
    integrator and the medium under their own names. Dials that `method` does not read stay at the scene's values, so
    that equal pictures are equal points."""

    method: str
    spp: int
    max_depth: int = 2
    samples: int = 384
    light_samples: int = 0
    environment_lights: int = 512
    map_resolution: int = 192
    map_source: str = "field"
    map_components: int = 1
    representation: str = "grid"

    @property
    def settings(self) -> "Point":
        """The same with one sample a pixel: points of equal settings have equal bias and differ in noise."""
        return replace(self, spp=1)

    def as_dict(self) -> dict[str, Any]:
        """JSON, by the names of the fields."""
        return asdict(self)


def from_dict(values: dict[str, Any]) -> Point:
    """The point that :meth:`Point.as_dict` was of."""
    return Point(**{f.name: values[f.name] for f in fields(Point)})


@dataclass(frozen=True)
class Dial:
    """Numbers between `low` and `high`, a coarse step apart by `factor`. `words`: values in place of numbers, each of
    which is a step from any other. `unlimited`: the number that stands for more than any other, None if none does;
    `first`: the number next to that; `relief`: share of the bias that one may hope a step takes away."""

    low: int = 1
    high: int = 1 << 16
    factor: float = 2.0
    words: tuple = ()
    unlimited: int | None = None
    first: int = 16
    relief: float = 0.3

    def steps(self, value, fine: bool) -> list[tuple[Any, int]]:
        """``(value, direction)`` of the values next to `value`; direction: 1 dearer, −1 cheaper, 0 neither known."""
        if self.words:
            return [] if fine else [(word, 0) for word in self.words if word != value]
        if value == self.unlimited:
            return [] if fine else [(self.first, -1)]
        factor = math.sqrt(self.factor) if fine else self.factor
        found = [(round(value * factor), 1), (round(value / factor), -1)]
        steps = [(v, way) for v, way in found if self.low <= v <= self.high and v != value]
        return steps + ([(self.unlimited, 1)] if self.unlimited is not None and value == self.first else [])


DIALS = {
    "spp": Dial(1, 1 << 14, 4.0),
    "samples": Dial(48, 1536),
    "light_samples": Dial(1, 256, 4.0, unlimited=0),
    "environment_lights": Dial(8, 8192, 4.0),
    "map_resolution": Dial(24, 768, relief=0.5),
    "map_source": Dial(words=("field", "network"), relief=0.5),
    "map_components": Dial(words=(1, 2), relief=0.5),
    "representation": Dial(words=("grid", "network"), relief=0.1),
}
"""Every dial that is turned. `max_depth` is one, too: see :func:`neighbours`."""
COMMON = ("spp", "samples", "light_samples", "environment_lights", "representation")
"""Dials of the integrator and the medium themselves, whatever the method; those of a method are its
:attr:`mi_ntf.infer.visibility.method.Method.dials`."""
NOT_TURNED = ("map_memory", "map_file")
"""Properties that methods read and that change neither error nor, much, time."""


@dataclass(frozen=True)
class Limits:
    """What the scene allows. `depth`: its own `max_depth`, the reference's; `environment`: it has one that is summed by
    cells; `texels`: most lights that it may become."""

    depth: int = 2
    environment: bool = True
    texels: int = 8192


def dials(point: Point, limits: Limits) -> list[str]:
    """Names of the dials that `point` has."""
    if point.method == STOCK:
        return ["spp"]
    method = REGISTRY[point.method]
    own = [name for name in method.dials if name in DIALS and name not in NOT_TURNED]
    found = [*COMMON, *own]
    if method.drawn:  # one map a light: none for lights that are drawn at random
        found.remove("light_samples")
    if point.light_samples or not limits.environment:
        found.remove("environment_lights")
    if "map_components" in found and point.map_source == "network":
        found.remove("map_components")  # the network has its own number
    return found


def neighbours(point: Point, limits: Limits, fine: bool = False) -> list[tuple[Point, str, int]]:
    """``(neighbour, dial, direction)`` of all points that differ from `point` by one step of one dial; `fine`: half a
    step, on a logarithmic scale. direction: 1 dearer, −1 cheaper, 0 not known."""
    found = []
    for name in dials(point, limits):
        for value, way in DIALS[name].steps(getattr(point, name), fine):
            if name == "environment_lights" and way > 0 and point.environment_lights >= limits.texels:
                continue
            found.append((replace(point, **{name: value}), name, way))
    if not fine and point.method not in (STOCK, "none"):  # light that `none` scatters meets no field again
        if point.max_depth != 2 and limits.depth != 2:
            found.append((replace(point, max_depth=2), "max_depth", -1))
        if point.max_depth == 2 and limits.depth != 2:
            found.append((replace(point, max_depth=limits.depth), "max_depth", 1))
    return found


def label(point: Point, base: Point) -> str:
    """The point for a reader: its method, the dials that differ from the scene's, its samples a pixel."""
    changed = [] if point.method == STOCK else _changed(point, base).values()
    return ", ".join([point.method, *changed, f"{point.spp} spp"])


def short(point: Point, base: Point, environment: bool) -> str:
    """The same in fewer words, for figures: "atlas, 512 lights, 4 spp". `environment`: the scene has one, which becomes
    `environment_lights` lights; their number is told then, whether it differs or not."""
    name = point.method.replace("transmittance", "").strip("_").replace("_", " ")
    changed = {} if point.method == STOCK else _changed(point, base)
    if environment and point.method != STOCK:
        changed.pop("environment_lights", None)
        several = "s" if (point.light_samples or point.environment_lights) > 1 else ""
        changed["light_samples"] = (f"{point.light_samples} drawn light{several}" if point.light_samples
                                    else f"{point.environment_lights} light{several}")
    return ", ".join([name, *changed.values(), f"{point.spp} spp"])


def _changed(point: Point, base: Point) -> dict[str, str]:
    """Words for the dials of `point` that differ from those of `base`, by their names."""
    words = {
        "max_depth": "single scattering" if point.max_depth == 2 else f"depth {point.max_depth}",
        "samples": f"{point.samples} steps",
        "light_samples": f"{point.light_samples} drawn light{'s' if point.light_samples > 1 else ''}"
                         if point.light_samples else "all lights",
        "environment_lights": f"{point.environment_lights} environment lights",
        "map_resolution": f"maps of {point.map_resolution}²",
        "map_source": f"filled by the {point.map_source}",
        "map_components": f"{point.map_components} logistic{'s' if point.map_components > 1 else ''}",
        "representation": f"field as {point.representation}",
    }
    return {name: text for name, text in words.items() if getattr(point, name) != getattr(base, name)}
