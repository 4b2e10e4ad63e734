"""The scene of a study, loaded with other properties than its own, whatever they are in its XML."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from ...core.errors import MiNtfError
from ...render.commands.explain import works
from ...render.cost import model
from ...render.lights import scene_lights
from ...render.maps import building
from ...render.plugins.registration import load_scene
from ...render.scene import changed, effects
from ...render.scene.media import find_media
from ...render.scene.settings import Settings
from .points import STOCK, Limits, Point

KEPT = ("map_memory", "bounces", "hide_emitters")
"""Properties of the scene's integrator that every point takes over."""


@dataclass(frozen=True)
class Picture:
    """The film of the study. `shrink`: how many of the scene's pixels one of its pixels stands for along each side;
    `crop`: (x, y, width, height) of it, None: all."""

    shrink: int = 1
    crop: tuple[int, int, int, int] | None = None


class Subject:
    """A scene file and the values of its $names. `base`: the point that it describes itself, `visibility` its own
    method; `size`: width and height of its film; `limits`: what its dials may be turned to; `digests`: of its fields.
    Raises MiNtfError where it cannot be rendered."""

    def __init__(self, path: Path, parameters: dict[str, str]):
        self.path, self.parameters = Path(path), dict(parameters)
        if not self.path.is_file():
            raise MiNtfError(f"scene {path} does not exist; give the XML file of a scene with an nrf medium")
        scene = load_scene(self.path, self.parameters)
        self.own = scene.integrator()
        media = find_media(scene)
        sensor = scene.sensors()[0]
        self.size = tuple(int(n) for n in sensor.film().crop_size())
        self.digests = [medium.field.digest for medium in media]
        self.visibility = self.own.visibility
        light = scene_lights.Lights(scene, media, 0, 1 << 16)
        found: Any = [d.cells for d in light.discrete if d.cells]
        cells = [int((c.weight > 0).sum()) for c in found]
        self.limits = Limits(self.own.max_depth, bool(cells), max(cells, default=0))
        self.lights = len(light.rows.power) + len(light.sampled)
        self.base = Point(
            "auto", sensor.sampler().sample_count(), self.own.max_depth, self.own.samples, self.own.light_samples,
            self.own.environment_lights, building.resolved(Settings.of(self.own), self.lights, media).map_resolution,
            self.own.map_source, self.own.map_components, media[0].representation)
        self.serves = {name: all(method.needs(m) for m in media) for name, method in model.REGISTRY.items()}

    def load(self, point: Point, picture: Picture):
        """The scene as `point` has it, without its integrator's own properties; `picture`: its film."""

        def change(node) -> None:
            if node.type == mi.ObjectType.Film:
                resize(node.props, picture)
            elif node.props.plugin_name() == "nrf" and node.type == mi.ObjectType.Medium:
                node.props["representation"] = point.representation

        return changed.load(self.path, self.parameters, change)

    def integrator(self, point: Point, timeout: float = -1.0):
        """The integrator of `point`; `timeout`: seconds."""
        own = self.own
        if point.method == STOCK:
            return mi.load_dict({"type": STOCK, "max_depth": point.max_depth, "hide_emitters": own.hide_emitters})
        dials = {name: getattr(point, name) for name in (
            "samples", "light_samples", "environment_lights", "map_resolution", "map_source", "map_components",
            "max_depth")}
        kept = {name: getattr(own, name) for name in KEPT}
        return mi.load_dict({"type": "nrf", "visibility": point.method, "timeout": timeout, **dials, **kept})

    def predicted(self, point: Point, scene) -> dict[str, float]:
        """Seconds that a picture by `point` would take (:mod:`mi_ntf.render.cost.model`), compilation left out:
        ``build``, what does not grow with pixels, and ``render``."""
        integrator, media, sensor = self.integrator(point), find_media(scene), scene.sensors()[0]
        light = scene_lights.Lights(scene, media, point.light_samples, point.environment_lights)
        width, height = (int(n) for n in sensor.film().crop_size())
        found = effects.describe(scene, Settings.of(integrator), sensor, point.spp, media, light)
        count = light.table(media[0].frame).count
        rays = width * height * point.spp
        stages: dict[str, float] = {}
        for work in works(integrator, media, found, rays, count, effects.drawn(integrator, light)):
            for name, seconds in model.seconds(work, model.constants()).items():
                stages[name] = stages.get(name, 0.0) + seconds
        build = stages.pop("maps or volumes", 0.0) + stages.pop("bounces", 0.0)
        return {"build": build, "render": sum(stages.values())}

    def key(self) -> str:
        """Hash of the scene's text, includes and $names in it, and of its fields."""
        text = mi.parser.write_string(changed.parsed(self.path, self.parameters))
        return hashlib.sha256(repr((text, self.digests)).encode()).hexdigest()


def resize(props, picture: Picture) -> None:
    """Make the film of `props` that of `picture`, and RGBA; a crop of the scene's own is shrunk with it."""
    for name, default in (("width", 768), ("height", 576)):
        props[name] = max(1, int(props.get(name, default)) // picture.shrink)
    crop = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
    own = [int(props.get(name, 0)) // picture.shrink for name in crop] if "crop_width" in props else None
    if picture.crop:
        x, y, width, height = picture.crop
        own = [x + (own[0] if own else 0), y + (own[1] if own else 0), width, height]
    if own:
        for name, value in zip(crop, own, strict=True):
            props[name] = value
    props["pixel_format"] = "rgba"
