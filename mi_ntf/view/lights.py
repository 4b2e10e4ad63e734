"""The lights of a view: their places, and how they are changed."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_ntf.core import rotation

from .camera import look_at
from .parameters import Parameters, Value, numbers

POWER = {"PointLight": "intensity.value", "SpotLight": "intensity.value", "DirectionalEmitter": "irradiance.value",
         "EnvironmentMapEmitter": "scale", "ConstantBackgroundEmitter": "radiance.value"}
"""Parameter that the emitted light is proportional to, by Mitsuba's class name."""
NAMES = {"PointLight": "point", "SpotLight": "spot", "DirectionalEmitter": "directional",
         "EnvironmentMapEmitter": "envmap", "ConstantBackgroundEmitter": "constant"}


@dataclass
class Light:
    """Emitter `number` of the scene and its changes since the scene was opened."""

    number: int
    kind: str  # name of the plugin
    emitter: mi.Emitter
    parameters: Parameters
    up: np.ndarray  # axis about which an environment turns, unit vector
    moved: bool = False  # place or direction were changed
    version: int = 0  # number of changes
    brightness: float = 1.0  # factor of the emission
    degrees: float = 0.0  # angle by which an environment is turned about `up`

    def __post_init__(self) -> None:
        power = POWER.get(self.emitter.class_name())
        self.can_dim = power is not None and self.parameters.has(self.emitter, power)
        self.can_move, self.can_turn = self.kind in ("point", "spot"), self.kind == "envmap"
        self.can_point = self.kind in ("spot", "directional")
        self._power = numbers(self._get(POWER[self.emitter.class_name()])) if self.can_dim else None
        has_transform = self.can_point or self.can_turn
        self.placement = numbers(self._get("to_world")) if has_transform else np.eye(4)  # light to scene

    @property
    def position(self) -> NDArray[np.float64]:
        """Position of a point or spot light, (3,)."""
        return numbers(self._get("position")) if self.kind == "point" else self.placement[:3, 3]

    @property
    def direction(self) -> NDArray[np.float64]:
        """Direction of the light of a spot or directional light, unit vector (3,)."""
        return np.asarray(self.placement[:3, 2] / np.linalg.norm(self.placement[:3, 2]))

    @property
    def power(self) -> NDArray[np.float64] | None:
        """Present emission, a number or colour. None for lights that cannot be dimmed."""
        return None if self._power is None else self._power * self.brightness

    def move(self, position: ArrayLike) -> None:
        """Put a point or spot light at the scene point `position`."""
        self.moved = True
        if self.kind == "point":
            self._set("position", np.asarray(position, np.float64))
        else:
            self.placement = self.placement.copy()
            self.placement[:3, 3] = position
            self._set("to_world", self.placement)

    def point(self, direction: ArrayLike) -> None:
        """Let a spot or directional light shine along `direction`."""
        self.moved = True
        forward = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        up = self.up if abs(forward @ self.up) < 0.99 else np.roll(self.up, 1)
        placement = look_at((0, 0, 0), forward, up)
        placement[:3, 3] = self.placement[:3, 3]
        self.placement = placement
        self._set("to_world", placement)

    def turn(self, degrees: float) -> None:
        """Turn an environment to `degrees` about the camera's up axis, relative to its place in the scene file."""
        self.degrees = float(degrees)
        turned = self.placement.copy()
        turned[:3] = rotation.about(self.up, self.degrees) @ turned[:3]
        self._set("to_world", turned)

    def dim(self, brightness: float) -> None:
        """Set the emission to `brightness` times that in the scene file."""
        self.brightness = float(brightness)
        power = self.power
        assert power is not None  # see can_dim
        self._set(POWER[self.emitter.class_name()], power if len(power) > 1 else float(power[0]))

    def _get(self, name: str) -> Value:
        return self.parameters.get(self.emitter, name)

    def _set(self, name: str, value: ArrayLike) -> None:
        self.parameters.set(self.emitter, name, value)
        self.version += 1


def lights_of(scene: mi.Scene, parameters: Parameters, up: np.ndarray) -> list[Light]:
    """Return all lights of a scene, in its order."""
    return [Light(number, NAMES.get(e.class_name(), e.class_name()), e, parameters, up)
            for number, e in enumerate(scene.emitters())]
