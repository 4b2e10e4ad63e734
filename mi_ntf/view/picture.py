"""One picture of a view: a method's image of the scene, of one layer a light, in passes that add up."""

from dataclasses import fields, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_ntf.render.scene.settings import Limits, Settings
from mi_ntf.render.transport import rendering
from mi_ntf.render.transport.seen import Seen


class Interrupted(Exception):
    """A pass was given up, because something moved."""


class Picture:
    """Renders `scene` by `settings`; in place of an ``nrf`` integrator, whose attributes it has.

    `groups`: numbers of the emitters of each layer; None: one layer of all. Layers of lights that stay as they were are
    kept, and so is what the camera's rays meet (`seen`).
    """

    def __init__(self, scene, settings: Settings, groups: list[tuple[int, ...]] | None = None):
        self.scene, self.settings, self.groups = scene, settings, groups
        self.limits, self.timeout, self.chunk = Limits(), -1.0, rendering.CHUNK
        self.patches: Any = None
        self.chosen: Any = None
        self.achieved: dict = {}
        self.aovs: tuple[str, ...] = ()
        self.lights_seen = 0
        self.seen: Seen | None = None
        self.stop = lambda: False
        self._layers: dict[tuple, tuple[Any, np.ndarray]] = {}
        self._rays: Any = None
        self.rendered: list[tuple] = []
        self._take(settings)

    def _take(self, settings: Settings) -> None:
        for each in fields(settings):
            setattr(self, each.name, getattr(settings, each.name))

    def should_stop(self) -> bool:
        """Asked for each chunk of pixels; leaves the render by an exception where something moved."""
        if self.stop():
            raise Interrupted
        return False

    def image(self, sensor, rays: tuple, versions: dict[int, int], seed: int, spp: int, keep: bool) -> np.ndarray:
        """(h, w, 4) linear RGB and opacity of `spp` samples a pixel.

        `rays`: whatever the camera's rays depend on; with it, `seed` and `spp` the same, only layers are rendered whose
        lights have other `versions` (by emitter). `keep`: False keeps nothing of this image for another one.
        """
        if not keep:
            self.seen = None
            return self._sum([self._render(sensor, group, seed, spp) for group in self._groups()])
        if self._rays != (rays, seed, spp):
            self._rays, self.seen, self._layers = (rays, seed, spp), Seen(), {}
        layers = []
        for group in self._groups():
            now = tuple(sorted(versions.items())) if group is None else tuple(versions[i] for i in group)
            found = self._layers.get(group or ())
            if found is None or found[0] != now:
                found = now, self._render(sensor, group, seed, spp)
                self._layers[group or ()] = found
            layers.append(found[1])
        return self._sum(layers)

    def _groups(self) -> list:
        return list(self.groups) if self.groups else [None]

    def _render(self, sensor, group: tuple[int, ...] | None, seed: int, spp: int) -> np.ndarray:
        self.only = group
        self.rendered.append(group or ())
        with dr.suspend_grad():
            return np.array(rendering.render(self, self.scene, sensor, seed, spp, True))

    @staticmethod
    def _sum(layers: list[np.ndarray]) -> np.ndarray:
        """Light adds; opacity is the same in all."""
        first = layers[0]
        if first.shape[2] == 3:
            first = np.concatenate([first, np.ones_like(first[..., :1])], axis=2)
        total = first.copy()
        for layer in layers[1:]:
            total[..., :3] += layer[..., :3]
            # A layer that shows an environment is opaque.
            total[..., 3:4] = np.maximum(total[..., 3:4], layer[..., 3:4] if layer.shape[2] > 3 else 1)
        return total

    def but(self, **changed) -> "Picture":
        """Another one, by other settings."""
        return Picture(self.scene, replace(self.settings, **changed), self.groups)
