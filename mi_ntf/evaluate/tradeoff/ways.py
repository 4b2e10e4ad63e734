"""The scene of a study, and the ways to render it that are compared."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.visibility import REGISTRY
from ...render.lights import scene_lights
from ...render.plugins.registration import load_scene
from ...render.scene import changed
from ...render.scene.media import find_media

PROPERTIES = ("samples", "light_samples", "environment_lights", "map_resolution", "map_source", "map_components",
              "map_memory", "max_depth", "bounces", "unbiased", "hide_emitters")
"""Properties of the scene's integrator that all ways take over: not its method, nor limits, files of maps and further
outputs."""
STOCK, MESH, BOUND = "volpath", "mesh", "none"
"""Ways besides the visibility methods, and the method that looks for no visibility: a bound, and no choice."""
DRAWN = 4
"""Lights drawn at each point in place of all. The samples of a pixel draw others each time, so that a few suffice, and
the picture costs that of four lights however many there are."""
BASELINES = ("ray_network", "visibility_mlp", "transmittance_volume")
"""Methods that are here to be compared with. They come late, as a single pass of theirs may take more than its share of
the budget, which the other ways would lack."""

_TITLES = {STOCK: "stock volpath", MESH: "exported mesh, stock path", BOUND: "no shadows",
           "visibility_mlp": "visibility MLP"}
_WORDS = {"samples": "{} steps", "light_samples": "{} lights drawn at each point",
          "environment_lights": "{} environment lights", "map_resolution": "{0}×{0} texels",
          "map_components": "{} logistics a texel", "bounces": "further light by {}",
          "unbiased": "corrected by marches at random"}


class Subject:
    """A scene file and the values of its $names.

    size          width and height of the scene's film
    media         the ``nrf`` media
    lights        number of lights with the scene's own dials
    environment   true if an environment is cut into lights
    properties    those of the scene's integrator, see `PROPERTIES`
    serves        names of the visibility methods that serve all media

    Raises MiNtfError where the scene cannot be rendered.
    """

    def __init__(self, path: Path, parameters: dict[str, str]):
        self.path, self.parameters = Path(path), dict(parameters)
        if not self.path.is_file():
            raise MiNtfError(f"scene {path} does not exist; give the XML file of a scene with an nrf medium")
        scene = load_scene(self.path, self.parameters)
        settings = scene.integrator().context.settings
        self.media = find_media(scene)
        self.size = tuple(int(n) for n in scene.sensors()[0].film().crop_size())
        self.properties: dict[str, Any] = {name: getattr(settings, name) for name in PROPERTIES}
        light = scene_lights.Lights(scene, self.media, 0, settings.environment_lights)
        self.environment = any(d.cells for d in light.discrete)
        self.lights = len(light.rows.power) + len(light.sampled)
        self.serves = [name for name, method in REGISTRY.items() if all(map(method.needs, self.media))]
        self._scenes: dict[int, Any] = {}

    def texels(self, method: str) -> int:
        """Return the texels along a side of the maps of `method`, where the scene does not name their number."""
        return REGISTRY[method].resolution(self.lights, max(m.field.grid.resolution for m in self.media))

    def scene(self, shrink: int):
        """Return the scene, loaded once, with one pixel for `shrink` of its own along each side."""

        def change(node) -> None:
            if node.type == mi.ObjectType.Film:
                changed.shrink_film(node.props, shrink)

        if shrink not in self._scenes:
            self._scenes[shrink] = changed.load(self.path, self.parameters, change)
        return self._scenes[shrink]

    def pixels(self, shrink: int) -> tuple[int, int]:
        """Return width and height of that picture."""
        width, height = (n // shrink for n in self.size)
        return width, height

    def key(self) -> str:
        """Return a hash of the scene's text, includes and $names in it, and of its fields."""
        text = mi.parser.write_string(changed.parsed(self.path, self.parameters))
        return hashlib.sha256(repr((text, [m.field.digest for m in self.media])).encode()).hexdigest()


@dataclass(frozen=True)
class Way:
    """Way to render the scene: a method, and dials that differ from the scene's own.

    method    name of a visibility method, `STOCK` or `MESH`
    changes   properties of the integrator that differ from the scene's own: finer or coarser dials
    """

    method: str
    changes: tuple[tuple[str, Any], ...] = ()

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
        """Mitsuba's name of the integrator."""
        return {STOCK: STOCK, MESH: "path"}.get(self.method, "nrf")

    def properties(self, subject: Subject) -> dict[str, Any]:
        """Return the properties of the integrator."""
        values = subject.properties
        if self.plugin != "nrf":
            return {name: values[name] for name in ("max_depth", "hide_emitters")}
        all_lights = {"light_samples": 0} if REGISTRY[self.method].sampled else {}  # its maps are of all lights
        return {"visibility": self.method} | values | all_lights | dict(self.changes)


def plan(subject: Subject, mesh: bool) -> list[Way]:
    """Return the ways of a study in their order; `mesh`: there is one to compare with.

    Every method that serves the scene, with the scene's own dials; stock ``volpath`` and the exported mesh before the
    `BASELINES`; and finer dials.
    """
    methods = [name for name in subject.serves if name not in BASELINES]
    stock = [STOCK, *([MESH] if mesh else []), *(name for name in BASELINES if name in subject.serves)]
    return [*map(Way, [*methods, *stock]), *finer(subject, subject.serves)]


def finer(subject: Subject, methods: list[str]) -> list[Way]:
    """Return `methods` with one other dial each, of one kind of dial after the other."""
    values, methods = subject.properties, [name for name in methods if name != BOUND]
    summed = [name for name in methods if not REGISTRY[name].sampled]
    dials: list[tuple[str, str, Any]] = []
    if subject.lights > DRAWN and not values["light_samples"]:
        dials += [(name, "light_samples", DRAWN) for name in summed]
    if not values["unbiased"]:
        dials += [(name, "unbiased", True) for name in methods if REGISTRY[name].automatic and REGISTRY[name].numbers]
    dials += [(name, "map_resolution", 2 * (values["map_resolution"] or subject.texels(name))) for name in methods
              if "map_resolution" in REGISTRY[name].dials]
    if values["map_components"] == 1 and values["map_source"] == "field":
        dials += [(name, "map_components", 2) for name in methods if "map_components" in REGISTRY[name].dials]
    dials.append(("raymarch", "samples", min(2 * values["samples"], 8192)))
    if values["bounces"] == "auto" and not 0 <= values["max_depth"] <= 2:
        dials += [(name, "bounces", "paths") for name in methods if REGISTRY[name].automatic]
    if subject.environment and not values["light_samples"]:
        cells = values["environment_lights"]
        dials += [(name, "environment_lights", min(4 * cells, 65536) if name in summed else max(cells // 4, 1))
                  for name in methods]
    return [Way(name, ((dial, value),)) for name, dial, value in dials]
