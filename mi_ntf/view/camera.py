"""Where the camera of a view stands: as a browser turns it, as Mitsuba's sensor has it."""

from dataclasses import dataclass

import numpy as np

from mi_ntf.core.errors import MiNtfError

from .parameters import Parameters, numbers

KINDS = ("PerspectiveCamera", "ThinLensCamera")


@dataclass(frozen=True)
class Pose:
    """`origin`, `target`: points of the scene; `up`: a direction; `fov`: of the picture's height, degrees."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) camera to scene, Mitsuba's axes: x left, y up, z forward."""
        origin, target = np.array(self.origin), np.array(self.target)
        forward = _unit(target - origin)
        left = _unit(np.cross(self.up, forward))
        matrix = np.eye(4)
        matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
        return matrix


def pose_of(sensor, parameters: Parameters, center: np.ndarray) -> Pose:
    """That of a sensor; its target is the point of its axis that is nearest to `center`. Raises MiNtfError where it is
    no camera with a pinhole or a lens."""
    if sensor.class_name() not in KINDS:
        raise MiNtfError(f"the scene's sensor is {sensor.class_name()}; mi-ntf view turns perspective and thinlens "
                         "ones")
    matrix = numbers(parameters.get(sensor, "to_world"))
    origin, forward, up = matrix[:3, 3], _unit(matrix[:3, 2]), _unit(matrix[:3, 1])
    away = max(float((center - origin) @ forward), 1e-3)
    width, height = (int(n) for n in sensor.film().crop_size())
    fov = fov_of_height(float(numbers(parameters.get(sensor, "x_fov"))[0]), width / height)
    return Pose(three(origin), three(origin + away * forward), three(up), fov)


def fov_of_height(x_fov: float, aspect: float) -> float:
    """Degrees of the height of a picture `aspect` times as wide as high, of those of its width."""
    return float(np.degrees(2 * np.arctan(np.tan(np.radians(x_fov) / 2) / aspect)))


def place(sensor, parameters: Parameters, pose: Pose, size: tuple[int, int]) -> None:
    """Put the sensor where `pose` says, with a picture of (width, height) pixels."""
    film = sensor.film()
    if tuple(int(n) for n in film.crop_size()) != size:
        parameters.set(film, "size", size)
        parameters.set(film, "crop_size", size)
        parameters.set(film, "crop_offset", (0, 0))
    parameters.set(sensor, "to_world", pose.matrix)
    parameters.set(sensor, "x_fov", fov_of_height(pose.fov, size[1] / size[0]))
    parameters.update()


def _unit(v) -> np.ndarray:
    return np.asarray(v, np.float64) / max(float(np.linalg.norm(v)), 1e-12)


def three(v) -> tuple[float, float, float]:
    """As plain numbers."""
    return float(v[0]), float(v[1]), float(v[2])
