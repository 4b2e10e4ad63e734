"""A scene that is being changed by hand, without a window: what was moved, and pictures of it, coarse or refined."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.visibility import names
from mi_ntf.render.lights import scene_lights
from mi_ntf.render.plugins.registration import load_scene
from mi_ntf.render.scene.media import find_media, ordinary_shapes
from mi_ntf.render.scene.settings import Settings
from mi_ntf.render.transport.aovs import CHANNELS

from . import camera, lights
from .parameters import Parameters
from .picture import Picture

COARSE = {"map_resolution": 128, "environment_lights": 32, "max_depth": 2}
"""Most of each while something moves."""
FRAMES = 1000
"""A method is chosen as for so many: what is built for a field pays."""
SEEN = tuple(name for name in CHANNELS if name != "visibility_lights")
"""What a view can show besides light."""
OWN_LAYERS = 8
"""Lights beyond these share a layer until they are moved."""
REST_CHUNK = 1 << 15
"""Camera rays between two looks at whether something moves."""


@dataclass(frozen=True)
class Frame:
    """`image` (h, w, 4), linear RGB and opacity, or (h, w, c) of an AOV; `seconds` that it took, and its samples a
    pixel. `right`: the same by the other method of a split view."""

    image: np.ndarray
    seconds: float
    samples: int
    right: np.ndarray | None = None


class Session:
    """The scene file `path`, `define` for its $names, seen in pictures of about `size`² pixels.

    Change `lights` by their methods, the rest by those of this class, from one thread; then ask for :meth:`preview` or
    :meth:`refine`. `stop`: asked while a pass of :meth:`refine` is rendered; True ends it by
    :class:`mi_ntf.view.picture.Interrupted`.
    """

    def __init__(self, path: Path, define: dict[str, str] | None = None, size: int = 256):
        self.path, self.define = Path(path), dict(define or {})
        self.stop: Callable[[], bool] = lambda: False
        self.shown, self.other = "", ""
        self.environment: Path | None = None
        self._passes, self._samples = 0, 0
        self._sums: list[np.ndarray] = []
        self._versions: dict[int, int] = {}  # of the lights, as they were rendered last
        self._load(load_scene(self.path, self.define))
        self.center = np.mean([m.frame.origin for m in self.media], axis=0)
        self.pose = self.opened = camera.pose_of(self.sensor, self.parameters, self.center)
        self.lights = lights.find(self.scene, self.parameters, np.array(self.pose.up))
        self.settings = self.before = Settings.of(self.scene.integrator()).but(frames=FRAMES)
        self._common = [light.number for light in self.lights[OWN_LAYERS:]]
        width, height = (int(n) for n in self.sensor.film().crop_size())
        self.resize(size, width / height)
        self._renew()

    def _load(self, scene) -> None:
        self.scene, self.parameters = scene, Parameters(scene)
        self.media = find_media(scene)
        self.sensor = scene.sensors()[0]

    def reopen(self, path: Path, environment: Path) -> None:
        """Go on with the scene file `path`: this one as it is now, but for its `environment`, a picture file."""
        self._load(load_scene(path, {}))
        self.environment = environment
        for light, emitter in zip(self.lights, self.scene.emitters(), strict=True):
            light.emitter, light.parameters, light.version = emitter, self.parameters, light.version + 1
        self._renew()

    def resize(self, size: int, aspect: float) -> None:
        """Pictures of about `size`² pixels, `aspect` times as wide as high."""
        self.edge = size
        self.size = max(1, round(size * aspect**0.5)), max(1, round(size / aspect**0.5))
        self._reset()

    def look(self, pose: camera.Pose) -> None:
        """See the scene from `pose`."""
        self.pose = pose
        self._reset()

    def choose(self, visibility: str | None = None, max_depth: int | None = None, other: str | None = None,
               shown: str | None = None) -> None:
        """The method that lights are seen through, the longest paths, the method of a split view's right side ("":
        none), the AOV that is shown ("": light). Raises MiNtfError where there is no such."""
        for name in (visibility, other or None):
            if name is not None and name not in names():
                raise MiNtfError(f'visibility is "{name}", expected one of {", ".join(names())}')
        if shown and shown not in SEEN:
            raise MiNtfError(f'there is no "{shown}" to show, expected one of {", ".join(SEEN)}')
        changed: dict = {"visibility": visibility, "max_depth": max_depth}
        self.settings = self.settings.but(**{k: v for k, v in changed.items() if v is not None})
        self.other = self.other if other is None else other
        self.shown = self.shown if shown is None else shown
        self._renew()

    def preview(self, divisor: int = 1) -> Frame:
        """The scene at once: one sample a pixel of a picture 1/`divisor` as wide and high, few lights for an
        environment, no further bounces. What is as it was in the preview before is not rendered again."""
        start = time.perf_counter()
        self._reset()
        width, height = (max(1, n // divisor) for n in self.size)
        self._place((width, height))
        images = [self._image(p, 0, 1, True) for p in self._previews]
        return Frame(images[0], time.perf_counter() - start, 1, images[1] if len(images) > 1 else None)

    def refine(self, spp: int = 1) -> Frame:
        """A further pass of `spp` samples a pixel by the scene's own settings, and the mean of all since the last
        change. Passes have seeds 0, 1, …"""
        start = time.perf_counter()
        self._place(self.size)
        images = [self._image(p, self._passes, spp, False) for p in self._finals]
        if not self._sums:
            self._sums = [np.zeros_like(image) for image in images]
        for total, image in zip(self._sums, images, strict=True):
            total += spp * image
        self._passes, self._samples = self._passes + 1, self._samples + spp
        means = [total / self._samples for total in self._sums]
        return Frame(means[0], time.perf_counter() - start, self._samples, means[1] if len(means) > 1 else None)

    @property
    def refined(self) -> bool:
        """Whether a pass of :meth:`refine` has ended since the last change."""
        return self._passes > 0

    def error(self) -> list[float]:
        """Relative RMSE against ``raymarch`` of each method shown: the same camera samples by both, one a pixel, so
        that noise is little of it."""
        from mi_ntf.evaluate.metrics import relative_rmse

        self._place(self.size)
        truth, *found = [
            self._image(p, 0, 1, False) for p in (self._final(visibility="raymarch"), *self._pictures(self._final))]
        return [relative_rmse(image[..., :3], truth[..., :3]) for image in found]

    def _image(self, picture: Picture, seed: int, spp: int, keep: bool) -> np.ndarray:
        picture.stop = (lambda: False) if keep else self.stop
        rays = self.pose, tuple(int(n) for n in self.sensor.film().crop_size())
        image = picture.image(self.sensor, rays, self._versions, seed, spp, keep)
        return image[..., -len(CHANNELS[self.shown]):] if self.shown else image

    def _place(self, size: tuple[int, int]) -> None:
        camera.place(self.sensor, self.parameters, self.pose, size)
        versions = {light.number: light.version for light in self.lights}
        if versions != self._versions:
            self._versions = versions
            self._reset()
        for light in self.lights:
            if light.moved and light.number in self._common:  # rebuilt once without it
                self._common.remove(light.number)
                self._renew()

    def _groups(self) -> list[tuple[int, ...]] | None:
        """A layer for each light, where light is the sum of its layers, bit for bit but for rounding."""
        if self.shown or self.settings.light_samples or ordinary_shapes(self.scene) or len(self.lights) < 2:
            return None
        if not all(scene_lights.is_discrete(light.emitter) for light in self.lights):
            return None
        own = [(light.number,) for light in self.lights if light.number not in self._common]
        return own + ([tuple(self._common)] if self._common else [])

    def _coarse(self, **changed) -> Picture:
        few = {name: min(getattr(self.settings, name), most) for name, most in COARSE.items()}
        if self.settings.max_depth < 0:
            few["max_depth"] = COARSE["max_depth"]
        return self._picture(self.settings.but(**(few | changed)), self._groups())

    def _final(self, **changed) -> Picture:
        return self._picture(self.settings.but(**changed), None)

    def _picture(self, settings: Settings, groups) -> Picture:
        picture = Picture(self.scene, settings, groups)
        picture.aovs = (self.shown,) if self.shown else ()
        return picture

    def _pictures(self, make: Callable[..., Picture]) -> list[Picture]:
        return [make(), *([make(visibility=self.other)] if self.other else [])]

    def _renew(self) -> None:
        """Pictures by other settings."""
        self._previews, self._finals = self._pictures(self._coarse), self._pictures(self._final)
        for picture in self._finals:
            picture.chunk = REST_CHUNK
        self._reset()

    def _reset(self) -> None:
        """Passes begin anew."""
        self._passes, self._samples, self._sums = 0, 0, []
