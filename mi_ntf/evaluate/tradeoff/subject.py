"""The scene of a study: loaded with smaller films, and rendered by other integrators than its own."""

import hashlib
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
              "map_memory", "max_depth", "bounces", "hide_emitters")
"""Properties of the scene's integrator that all ways take over: not its method, nor limits, files of maps and further
outputs."""


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
        own = scene.integrator()
        self.media = find_media(scene)
        self.size = tuple(int(n) for n in scene.sensors()[0].film().crop_size())
        self.properties: dict[str, Any] = {name: getattr(own, name) for name in PROPERTIES}
        light = scene_lights.Lights(scene, self.media, 0, own.environment_lights)
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
