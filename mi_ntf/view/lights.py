"""The lights of a view: where they are, and how they are moved."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .parameters import Parameters, numbers

POWER = {"PointLight": "intensity.value", "SpotLight": "intensity.value", "DirectionalEmitter": "irradiance.value",
         "EnvironmentMapEmitter": "scale", "ConstantBackgroundEmitter": "radiance.value"}
"""Mitsuba's class name → parameter that light is in proportion to."""
NAMES = {"PointLight": "point", "SpotLight": "spot", "DirectionalEmitter": "directional",
         "EnvironmentMapEmitter": "envmap", "ConstantBackgroundEmitter": "constant"}


@dataclass
class Light:
    """Emitter `number` of the scene, of kind `kind` (the plugin's name): what of it can be changed, and how it was.

    moved      since the scene was opened
    version    grows with every change
    brightness factor on what it emits in the scene
    degrees    that an environment is turned about `up`
    """

    number: int
    kind: str
    emitter: Any
    parameters: Parameters
    up: np.ndarray
    moved: bool = False
    version: int = 0
    brightness: float = 1.0
    degrees: float = 0.0

    def __post_init__(self) -> None:
        self._power = numbers(self._get(POWER[self.emitter.class_name()])) if self.can_dim else None
        placed = self.kind in ("spot", "directional", "envmap")
        self._placement = numbers(self._get("to_world")) if placed else np.eye(4)

    @property
    def can_move(self) -> bool:
        return self.kind in ("point", "spot")

    @property
    def can_point(self) -> bool:
        return self.kind in ("spot", "directional")

    @property
    def can_turn(self) -> bool:
        return self.kind == "envmap"

    @property
    def can_dim(self) -> bool:
        name = POWER.get(self.emitter.class_name())
        return name is not None and self.parameters.has(self.emitter, name)

    @property
    def position(self) -> np.ndarray:
        """(3,) of a point or spot light."""
        return numbers(self._get("position")) if self.kind == "point" else self._placement[:3, 3]

    @property
    def direction(self) -> np.ndarray:
        """(3,) that a spot or directional light shines in, unit."""
        return self._placement[:3, 2] / np.linalg.norm(self._placement[:3, 2])

    @property
    def placement(self) -> np.ndarray:
        """(4, 4) light to scene."""
        return self._placement

    @property
    def power(self) -> np.ndarray | None:
        """What it emits now; None where that is no number or colour."""
        return None if self._power is None else self._power * self.brightness

    def move(self, position) -> None:
        """Put a point or spot light at the scene point `position`."""
        self.moved = True
        if self.kind == "point":
            self._set("position", np.asarray(position, np.float64))
        else:
            self._placement = self._placement.copy()
            self._placement[:3, 3] = position
            self._set("to_world", self._placement)

    def point(self, direction) -> None:
        """Let a spot or directional light shine along `direction`."""
        self.moved = True
        z = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        x = np.cross(self.up if abs(z @ self.up) < 0.99 else np.roll(self.up, 1), z)
        x /= np.linalg.norm(x)
        self._placement = self._placement.copy()
        self._placement[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        self._set("to_world", self._placement)

    def turn(self, degrees: float) -> None:
        """Turn an environment to `degrees` about the camera's up axis, counted from where the scene has it."""
        self.degrees = float(degrees)
        self._set("to_world", rotation(self.up, self.degrees) @ self._placement)

    def dim(self, brightness: float) -> None:
        """Let it emit `brightness` times what it does in the scene."""
        self.brightness = float(brightness)
        power = self.power
        assert power is not None  # see can_dim
        self._set(POWER[self.emitter.class_name()], power if len(power) > 1 else float(power[0]))

    def _get(self, name: str):
        return self.parameters.get(self.emitter, name)

    def _set(self, name: str, value) -> None:
        self.parameters.set(self.emitter, name, value)
        self.version += 1


def find(scene, parameters: Parameters, up: np.ndarray) -> list[Light]:
    """All lights of a scene, in its order."""
    return [Light(number, NAMES.get(e.class_name(), e.class_name()), e, parameters, up)
            for number, e in enumerate(scene.emitters())]


def rotation(axis: np.ndarray, degrees: float) -> np.ndarray:
    """(4, 4), by the right hand about the unit vector `axis` (Rodrigues)."""
    angle, k = np.radians(degrees), np.cross(np.eye(3), axis)
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * k
    matrix[:3, :3] += (1 - np.cos(angle)) * k @ k
    return matrix
