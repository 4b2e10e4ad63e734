"""Image of the scene by one method, in layers by lights and in passes that add up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.render.scene.settings import Settings
from mi_ntf.render.transport import rendering
from mi_ntf.render.transport.camera_light import SampleCache
from mi_ntf.render.transport.context import RenderContext

Group: TypeAlias = tuple[int, ...] | None
"""Numbers of the emitters of a layer. None stands for all."""


class Interrupted(Exception):
    """Exception that ends a pass, because something moved."""


class Picture:
    """Renderer of `scene` by `settings`, without an ``nrf`` integrator.

    `groups` has the emitters of each layer; None makes one layer of all. Layers of unchanged lights are stored, and so
    are the samples of the camera's rays, in the `context`.
    """

    def __init__(self, scene: mi.Scene, settings: Settings, groups: list[tuple[int, ...]] | None = None) -> None:
        self.scene, self.settings = scene, settings
        self.groups: list[Group] = list(groups) if groups else [None]
        self.context = RenderContext(settings)
        self.stop: Callable[[], bool] = lambda: False
        self._layers: dict[Group, tuple[tuple[object, ...], np.ndarray]] = {}
        self._samples: tuple[object, ...] = ()
        self.rendered: list[Group] = []

    @property
    def method(self) -> str:
        """Visibility method of the latest image, with its name in the scene if that is ``auto``."""
        name = self.settings.visibility
        return f"{name}: {self.context.achieved['visibility']}" if name == "auto" else name

    def should_stop(self) -> bool:
        """Raise Interrupted if something moved. The renderer asks for each chunk of pixels."""
        if self.stop():
            raise Interrupted
        return False

    def image(self, sensor: mi.Sensor, rays: object, versions: dict[int, int], seed: int, spp: int,
              keep: bool) -> np.ndarray:
        """Return linear RGB and opacity, (h, w, 4).

        `rays` is all that the camera's rays depend on, `versions` the version of each light by the emitter's number.
        With the same `rays`, `seed` and `spp`, only layers of other versions are rendered again. `keep` False stores
        nothing.
        """
        if not keep:
            self.context.sample_cache = None
            return self._sum([self._render(sensor, group, seed, spp) for group in self.groups])
        if self._samples != (rays, seed, spp):
            self._samples, self.context.sample_cache, self._layers = (rays, seed, spp), SampleCache(), {}
        layers = []
        for group in self.groups:
            version: tuple[object, ...] = (
                tuple(sorted(versions.items())) if group is None else tuple(versions[i] for i in group))
            stored = self._layers.get(group)
            if stored is None or stored[0] != version:
                stored = self._layers[group] = version, self._render(sensor, group, seed, spp)
            layers.append(stored[1])
        return self._sum(layers)

    def _render(self, sensor: mi.Sensor, group: Group, seed: int, spp: int) -> np.ndarray:
        self.context.settings = replace(self.settings, only_emitters=group)
        self.rendered.append(group)
        with dr.suspend_grad():  # type: ignore[no-untyped-call]
            return np.array(rendering.render(self.context, self.scene, sensor, seed, spp, True, self.should_stop))

    @staticmethod
    def _sum(layers: list[np.ndarray]) -> np.ndarray:
        """Return the sum of light, and the opacity, which is the same in all layers."""
        first = layers[0]
        if first.shape[2] == 3:
            first = np.concatenate([first, np.ones_like(first[..., :1])], axis=2)
        total: np.ndarray = first.copy()
        for layer in layers[1:]:
            total[..., :3] += layer[..., :3]
            # A layer that shows an environment is opaque.
            total[..., 3:4] = np.maximum(total[..., 3:4], layer[..., 3:4] if layer.shape[2] > 3 else 1)
        return total
