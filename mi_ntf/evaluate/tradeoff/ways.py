"""The scene of a study, and the ways to render it that are compared."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.visibility import REGISTRY
from ...render.lights import scene_lights
from ...render.maps import building
from ...render.plugins.registration import load_scene
from ...render.scene import changed, environment_option, scene_file
from ...render.scene.environment_option import Environment
from ...render.scene.media import find_media
from ...render.scene.settings import Settings
from ..recipes import Properties, Value

if TYPE_CHECKING:
    from ...render.scene.changed import Node

PROPERTIES = ("samples", "light_samples", "environment_lights", "map_resolution", "map_source", "map_components",
              "map_memory", "max_depth", "bounces", "unbiased", "hide_emitters")
"""Properties of the scene's integrator that all ways use; its method, limits, map files and outputs are left out."""
STOCK, MESH, BOUND = "volpath", "mesh", "none"
"""Ways besides the visibility methods, and the method without visibility, which is a bound, not a choice."""
MOST_STEPS = 8192
"""Largest number of steps of a march that the integrator takes."""
SAMPLED = 4
"""Lights sampled at each point in place of all; a few suffice, since each sample of a pixel takes others."""
BASELINES = ("ray_network", "visibility_mlp", "transmittance_volume")
"""Methods for comparison. They come late, since a single pass may take more than its part of the budget."""

_TITLES = {STOCK: "stock volpath", MESH: "exported mesh, stock path", BOUND: "no shadows",
           "visibility_mlp": "visibility MLP"}
_WORDS = {"samples": "{} steps", "light_samples": "{} lights sampled at each point",
          "environment_lights": "{} environment lights", "map_resolution": "{0}×{0} texels",
          "map_components": "{} logistics a texel", "bounces": "further light by {}",
          "unbiased": "corrected by marches at random"}


class Subject:
    """A scene file, the values of its $names, and the changes of its environment.

    - env: changes of the environment
    - size: width and height of the scene's film
    - media: the ``nrf`` media
    - lights: number of lights with the scene's own dials
    - environment: true if an environment is cut into lights
    - properties: values of `PROPERTIES` of the scene's integrator
    - finer_steps: twice the steps of the scene's marches
    - methods: names of the visibility methods that support all media

    Raises MiNtfError where the scene cannot be rendered.
    """

    def __init__(self, path: Path, parameters: dict[str, str], environment: Environment | None = None):
        self.path, self.parameters, self.env = Path(path), dict(parameters), environment or Environment()
        if not self.path.is_file():
            raise MiNtfError(f"scene {path} does not exist; give the XML file of a scene with an nrf medium")
        scene = load_scene(self.path, self.parameters, self.env)
        integrator: Any = scene.integrator()
        settings: Settings = integrator.context.settings
        self.media = find_media(scene)
        width, height = scene.sensors()[0].film().crop_size()
        self.size = int(width), int(height)
        self.properties: Properties = {name: getattr(settings, name) for name in PROPERTIES}
        light = scene_lights.Lights(scene, self.media, 0, settings.environment_lights)
        self.environment = any(d.cells for d in light.discrete)
        self.lights = len(light.rows.power) + len(light.sampled)
        self.methods = [name for name, method in REGISTRY.items() if all(map(method.needs, self.media))]
        steps = settings.samples or max(map(building.samples, self.media))
        self.finer_steps = min(2 * steps, MOST_STEPS)
        self._scenes: dict[int, mi.Scene] = {}

    def texels(self, method: str) -> int:
        """Return the default number of texels along a side of the maps of `method`."""
        return REGISTRY[method].resolution(self.lights, max(m.field.grid.resolution for m in self.media))

    def scene(self, shrink: int) -> "mi.Scene":
        """Return the scene, loaded once, with one pixel for `shrink` of its own along each side."""
        if shrink not in self._scenes:
            self._scenes[shrink] = scene_file.load(self.path, self.parameters, self.env, change=shrinker(shrink))
        return self._scenes[shrink]

    def pixels(self, shrink: int) -> tuple[int, int]:
        """Return width and height of the picture of :meth:`scene`."""
        width, height = (n // shrink for n in self.size)
        return width, height

    def key(self) -> str:
        """Return a hash of the scene's text, with includes and $names inserted, and of its files and fields."""
        state = changed.parsed(self.path, self.parameters)
        environment_option.apply(self.env, state, self.path)
        with changed.beside(self.path):
            content = changed.content_of_files(state)
        text = mi.parser.write_string(state)
        return hashlib.sha256(repr((text, content, [m.field.digest for m in self.media])).encode()).hexdigest()


def shrinker(shrink: int) -> Callable[["Node"], None]:
    """Return a function for :func:`mi_ntf.render.scene.scene_file.load` that shrinks the film."""

    def change(node: "Node") -> None:
        if node.type == mi.ObjectType.Film:
            changed.shrink_film(node.props, shrink)

    return change


@dataclass(frozen=True)
class Way:
    """Way to render the scene: a method, and dials that differ from the scene's own.

    - method: name of a visibility method, `STOCK` or `MESH`
    - changes: properties of the integrator that differ from the scene's own: finer or coarser dials
    """

    method: str
    changes: tuple[tuple[str, Value], ...] = ()

    @property
    def name(self) -> str:
        """Short name, for files."""
        return "-".join([self.method, *(f"{name}-{value}" for name, value in self.changes)])

    @property
    def title(self) -> str:
        """Description in words."""
        words = [_WORDS[name].format(value) for name, value in self.changes]
        return ", ".join([_TITLES.get(self.method, self.method.replace("_", " ")), *words])

    @property
    def plugin(self) -> str:
        """Name of the integrator's plugin."""
        return {STOCK: STOCK, MESH: "path"}.get(self.method, "nrf")

    def properties(self, subject: Subject) -> Properties:
        """Return the properties of the integrator."""
        values = subject.properties
        if self.plugin != "nrf":
            return {name: values[name] for name in ("max_depth", "hide_emitters")}
        every: Properties = {"light_samples": 0} if REGISTRY[self.method].sampled else {}  # its maps are of all lights
        return {"visibility": self.method, **values, **every, **dict(self.changes)}


def plan(subject: Subject, mesh: bool) -> list[Way]:
    """Return the ways of a study in their order; `mesh` is true if there is a mesh to compare with.

    First come all methods of the scene with the scene's own dials. Stock ``volpath`` and the exported mesh stand before
    the `BASELINES` among them. Finer dials follow.
    """
    methods = [name for name in subject.methods if name not in BASELINES]
    stock = [STOCK, *([MESH] if mesh else []), *(name for name in BASELINES if name in subject.methods)]
    return [*map(Way, [*methods, *stock]), *finer(subject, subject.methods)]


def finer(subject: Subject, methods: list[str]) -> list[Way]:
    """Return ways that change one dial of one of `methods`, ordered by dial."""
    values, methods = subject.properties, [name for name in methods if name != BOUND]
    summed = [name for name in methods if not REGISTRY[name].sampled]
    dials: list[tuple[str, str, Value]] = []
    if subject.lights > SAMPLED and not values["light_samples"]:
        dials += [(name, "light_samples", SAMPLED) for name in summed]
    if not values["unbiased"]:
        dials += [(name, "unbiased", True) for name in methods if REGISTRY[name].automatic and REGISTRY[name].numbers]
    dials += [(name, "map_resolution", 2 * (int(values["map_resolution"]) or subject.texels(name))) for name in methods
              if "map_resolution" in REGISTRY[name].dials]
    if values["map_components"] != 2 and values["map_source"] == "field":
        dials += [(name, "map_components", 2) for name in methods if "map_components" in REGISTRY[name].dials]
    dials.append(("raymarch", "samples", subject.finer_steps))
    if values["bounces"] == "auto" and not 0 <= int(values["max_depth"]) <= 2:
        dials += [(name, "bounces", "paths") for name in methods if REGISTRY[name].automatic]
    if subject.environment and not values["light_samples"]:
        cells = int(values["environment_lights"])
        dials += [(name, "environment_lights", min(4 * cells, 65536) if name in summed else max(cells // 4, 1))
                  for name in methods]
    return [Way(name, ((dial, value),)) for name, dial, value in dials]
