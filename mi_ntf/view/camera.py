"""The camera of a view: its pose as a browser has it, and Mitsuba's sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_ntf.core.errors import MiNtfError

from .parameters import Parameters, numbers

SENSORS = ("PerspectiveCamera", "ThinLensCamera")
Triple: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True)
class Pose:
    """Pose of a camera: the scene points `origin` and `target`, direction `up`, and field of view in degrees.

    `fov` is that of the picture's height.
    """

    origin: Triple
    target: Triple
    up: Triple
    fov: float

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Camera to scene, (4, 4), with Mitsuba's axes: x left, y up, z forward."""
        return look_at(self.origin, self.target, self.up)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
    """Return the (4, 4) transform of an object at `origin` whose z axis points to `target`, in double precision."""
    vectors = (np.asarray(v, np.float64).tolist() for v in (origin, target, up))
    return np.array(mi.ScalarTransform4d().look_at(*vectors).matrix, np.float64).reshape(4, 4)


def pose_of(sensor: mi.Sensor, parameters: Parameters, center: np.ndarray) -> Pose:
    """Return the pose of a sensor. Its target is the point of the optical axis that is nearest to `center`.

    Raises MiNtfError for sensors other than ``perspective`` and ``thinlens``.
    """
    if sensor.class_name() not in SENSORS:
        raise MiNtfError(f"the scene's sensor is {sensor.class_name()}; mi-ntf view turns perspective and thinlens "
                         "ones")
    matrix = numbers(parameters.get(sensor, "to_world"))
    origin, forward, up = matrix[:3, 3], _unit(matrix[:3, 2]), _unit(matrix[:3, 1])
    distance = max(float((center - origin) @ forward), 1e-3)
    width, height = (int(n) for n in sensor.film().crop_size())
    fov = fov_of_height(float(numbers(parameters.get(sensor, "x_fov"))[0]), width / height)
    return Pose(triple(origin), triple(origin + distance * forward), triple(up), fov)


def fov_of_height(fov_of_width: float, aspect: float) -> float:
    """Return the vertical field of view in degrees of a picture `aspect` times as wide as high."""
    return float(np.degrees(2 * np.arctan(np.tan(np.radians(fov_of_width) / 2) / aspect)))


def fov_of_window(fov: float, aspect: float, window: float) -> float:
    """Return the vertical field of view in which a window shows a whole picture.

    fov     the picture's vertical field of view in degrees
    aspect  width of the picture over its height
    window  width of the window over its height
    """
    return float(np.degrees(2 * np.arctan(np.tan(np.radians(fov) / 2) * max(1.0, aspect / window))))


def place(sensor: mi.Sensor, parameters: Parameters, pose: Pose, size: tuple[int, int]) -> None:
    """Give the sensor the pose `pose` and a picture of (width, height) pixels."""
    film = sensor.film()
    if tuple(int(n) for n in film.crop_size()) != size:
        parameters.set(film, "size", size)
        parameters.set(film, "crop_size", size)
        parameters.set(film, "crop_offset", (0, 0))
    parameters.set(sensor, "to_world", pose.matrix)
    parameters.set(sensor, "x_fov", fov_of_height(pose.fov, size[1] / size[0]))
    parameters.update()


def triple(vector: ArrayLike) -> Triple:
    """Return a vector as plain numbers."""
    x, y, z = np.asarray(vector, np.float64).tolist()
    return x, y, z


def _unit(vector: np.ndarray) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), np.float64)
