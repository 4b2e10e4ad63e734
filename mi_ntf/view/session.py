"""A scene that is changed interactively, without a window: its changes, and pictures of it, coarse or refined."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.visibility import names
from mi_ntf.render.lights import scene_lights
from mi_ntf.render.plugins.registration import load_scene
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.render.scene.media import find_media, ordinary_shapes
from mi_ntf.render.scene.settings import Settings
from mi_ntf.render.transport.aovs import CHANNELS
from mi_ntf.render.transport.context import RenderContext

from . import camera
from .lights import lights_of
from .parameters import Parameters
from .picture import Picture

PREVIEW = {"map_resolution": 128, "environment_lights": 32, "max_depth": 2}
"""Upper limits of settings while something moves."""
FRAMES = 1000
"""Value of the setting ``frames``: many frames pay for what is built for a field."""
AOVS = tuple(name for name in CHANNELS if name != "visibility_lights")
"""Outputs that a view can show in place of light."""
MAX_LAYERS = 8
"""Lights beyond these share a layer until they are moved."""
REST_CHUNK = 1 << 15
"""Camera rays between two checks for changes."""


@dataclass(frozen=True)
class Frame:
    """Image of a view."""

    image: np.ndarray  # linear RGB and opacity, (h, w, 4), or an AOV, (h, w, c)
    seconds: float
    samples: int  # per pixel
    methods: tuple[str, ...]  # visibility method, and the second one of a split view
    right: np.ndarray | None = None  # by the second method


class Session:
    """The scene file `path`, with values `define` of its $names, in pictures of at most about `limit`² pixels.

    `environment` has changes of the scene's environment, which :func:`mi_ntf.view.save.save` writes, too.

    Lights are changed by the methods of `lights`, everything else by those of this class, from one thread. `stop` is
    called while :meth:`refine` renders. If it returns True, :class:`mi_ntf.view.picture.Interrupted` ends the pass.
    """

    def __init__(self, path: Path, define: dict[str, str] | None = None, limit: int = 512,
                 environment: Environment | None = None) -> None:
        self.path, self.define = Path(path), dict(define or {})
        self.stop: Callable[[], bool] = lambda: False
        self.aov, self.second_visibility = "", ""
        self.limit, self.option = limit, environment or Environment()
        self.environment = self.option.file  # picture in place of the scene's own
        self._passes, self._samples = 0, 0
        self._sums: list[np.ndarray] = []
        self._versions: dict[int, int] = {}  # of the lights in the latest picture
        self._load(load_scene(self.path, self.define, self.option))
        self.center = np.mean([m.frame.origin for m in self.media], axis=0)
        self.pose = self.initial_pose = camera.pose_of(self.sensor, self.parameters, self.center)
        self.lights = lights_of(self.scene, self.parameters, np.array(self.pose.up))
        context = getattr(self.scene.integrator(), "context", None)
        assert isinstance(context, RenderContext)  # load_scene refuses other integrators than nrf
        self.settings = self.initial_settings = replace(context.settings, frames=FRAMES, map_file="")
        self._common = [light.number for light in self.lights[MAX_LAYERS:]]
        width, height = (int(n) for n in self.sensor.film().crop_size())
        self.aspect = width / height  # of the scene's own picture
        self.size = _size(limit, self.aspect)
        self._make_pictures()

    def _load(self, scene: mi.Scene) -> None:
        self.scene, self.parameters = scene, Parameters(scene)
        self.media = find_media(scene)
        self.sensor = scene.sensors()[0]

    def reopen(self, path: Path, environment: Path) -> None:
        """Continue with the scene file `path`, which differs by its `environment`, a picture file."""
        self._load(load_scene(path, {}))
        self.environment = environment
        for light, emitter in zip(self.lights, self.scene.emitters(), strict=True):
            light.emitter, light.parameters, light.version = emitter, self.parameters, light.version + 1
        self._make_pictures()

    def fit(self, width: int, height: int) -> None:
        """Make pictures for a window of `width` × `height` pixels."""
        size = _size(min(self.limit, (width * height) ** 0.5), width / height)
        if size != self.size:
            self.size = size
            self._restart()

    def look(self, pose: camera.Pose) -> None:
        """Set the camera."""
        self.pose = pose
        self._restart()

    def choose(self, visibility: str | None = None, max_depth: int | None = None, second_visibility: str | None = None,
               aov: str | None = None) -> None:
        """Change how the scene is rendered. None keeps a value.

        `second_visibility` is the method of the right side of a split view, "" ends the split. `aov` is the output to
        show, one of `AOVS`, "" is light. Raises MiNtfError if a name is unknown.
        """
        for name in (visibility, second_visibility or None):
            if name is not None and name not in names():
                raise MiNtfError(f'visibility is "{name}", expected one of {", ".join(names())}')
        if aov and aov not in AOVS:
            raise MiNtfError(f'there is no "{aov}" to show, expected one of {", ".join(AOVS)}')
        if visibility is not None:
            self.settings = replace(self.settings, visibility=visibility)
        if max_depth is not None:
            self.settings = replace(self.settings, max_depth=max_depth)
        if second_visibility is not None:
            self.second_visibility = second_visibility
        if aov is not None:
            self.aov = aov
        self._make_pictures()

    def preview(self, divisor: float = 1) -> Frame:
        """Render fast: one sample per pixel, few lights for an environment, no further bounces.

        The picture is 1/`divisor` as wide and high. Layers that are as in the last preview are not rendered again.
        """
        start = time.perf_counter()
        self._restart()
        width, height = (max(1, round(n / divisor)) for n in self.size)
        self._place((width, height))
        images = [self._image(p, 0, 1, True) for p in self._previews]
        return Frame(images[0], time.perf_counter() - start, 1, _methods(self._previews), *images[1:])

    def refine(self, spp: int = 1) -> Frame:
        """Render a pass of `spp` samples per pixel by the scene's settings, and return the mean since the last change.

        Passes have seeds 0, 1, …
        """
        start = time.perf_counter()
        self._place(self.size)
        images = [self._image(p, self._passes, spp, False) for p in self._finals]
        if not self._sums:
            self._sums = [np.zeros_like(image) for image in images]
        for total, image in zip(self._sums, images, strict=True):
            total += spp * image
        self._passes, self._samples = self._passes + 1, self._samples + spp
        means = [total / self._samples for total in self._sums]
        return Frame(means[0], time.perf_counter() - start, self._samples, _methods(self._finals), *means[1:])

    @property
    def refined(self) -> bool:
        """True if a pass of :meth:`refine` has ended since the last change."""
        return self._passes > 0

    def error(self) -> list[tuple[str, float]]:
        """Return the name of each shown method, and its relative RMSE against ``raymarch``.

        All render the same samples, one per pixel, so that noise contributes little.
        """
        from mi_ntf.evaluate.metrics import relative_rmse

        self._place(self.size)
        pictures = [self._final(visibility="raymarch"), *self._by_methods(self._final)]
        truth, *images = [self._image(picture, 0, 1, False) for picture in pictures]
        errors = [relative_rmse(image[..., :3], truth[..., :3]) for image in images]
        return list(zip(_methods(pictures[1:]), errors, strict=True))

    def _image(self, picture: Picture, seed: int, spp: int, keep: bool) -> np.ndarray:
        picture.stop = (lambda: False) if keep else self.stop
        rays = self.pose, tuple(int(n) for n in self.sensor.film().crop_size())
        image = picture.image(self.sensor, rays, self._versions, seed, spp, keep)
        return image[..., -len(CHANNELS[self.aov]):] if self.aov else image

    def _place(self, size: tuple[int, int]) -> None:
        camera.place(self.sensor, self.parameters, self.pose, size)
        versions = {light.number: light.version for light in self.lights}
        if versions != self._versions:
            self._versions = versions
            self._restart()
        for light in self.lights:
            if light.moved and light.number in self._common:  # the common layer is rendered once without it
                self._common.remove(light.number)
                self._make_pictures()

    def _groups(self) -> list[tuple[int, ...]] | None:
        """Return a layer for each light, None where light is not the sum of such layers."""
        if self.aov or self.settings.light_samples or ordinary_shapes(self.scene) or len(self.lights) < 2:
            return None
        if not all(scene_lights.is_discrete(light.emitter) for light in self.lights):
            return None
        single = [(light.number,) for light in self.lights if light.number not in self._common]
        return single + ([tuple(self._common)] if self._common else [])

    def _preview(self, visibility: str | None = None) -> Picture:
        limited = {name: min(getattr(self.settings, name), limit) for name, limit in PREVIEW.items()}
        if self.settings.max_depth < 0:
            limited["max_depth"] = PREVIEW["max_depth"]
        return self._picture(replace(self.settings, **limited), visibility, self._groups())

    def _final(self, visibility: str | None = None) -> Picture:
        return self._picture(self.settings, visibility, None)

    def _picture(self, settings: Settings, visibility: str | None, groups: list[tuple[int, ...]] | None) -> Picture:
        picture = Picture(self.scene, replace(settings, visibility=visibility or settings.visibility), groups)
        picture.context.aovs = (self.aov,) if self.aov else ()
        return picture

    def _by_methods(self, make: Callable[[str | None], Picture]) -> list[Picture]:
        return [make(None), *([make(self.second_visibility)] if self.second_visibility else [])]

    def _make_pictures(self) -> None:
        """Make pictures by the present settings."""
        self._previews, self._finals = self._by_methods(self._preview), self._by_methods(self._final)
        for picture in self._finals:
            picture.context.rays_in_flight = REST_CHUNK
        self._restart()

    def _restart(self) -> None:
        """Begin the passes anew."""
        self._passes, self._samples, self._sums = 0, 0, []


def _size(edge: float, aspect: float) -> tuple[int, int]:
    """Return the width and height of a picture of about `edge`² pixels, `aspect` times as wide as high."""
    return max(1, round(edge * aspect**0.5)), max(1, round(edge / aspect**0.5))


def _methods(pictures: list[Picture]) -> tuple[str, ...]:
    return tuple(picture.method for picture in pictures)
