"""The three files of a COLMAP model, text or binary, read within their own length.

Source of the forms: COLMAP's documentation, "Output format". The files `rigs` and `frames` of newer models repeat what
`images` says of single cameras and are left aside.
"""

import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data.images import is_file_name

MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}  # fmt: skip
"""Camera models by the number that binary files call them, and how many parameters each has."""


class Camera(NamedTuple):
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class Image(NamedTuple):
    name: str
    camera: int
    quaternion: tuple[float, ...]
    """w, x, y, z of the rotation from world to camera, not normalised."""
    translation: tuple[float, ...]


def read(folder: Path) -> tuple[dict[int, Camera], list[Image], np.ndarray]:
    """``(cameras by number, images, points (P, 3))`` of the model in `folder`; binary files come first.

    Raises MiNtfError, with the file's name, where one is missing or is not what COLMAP writes.
    """
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    readers = (_cameras_bin, _images_bin, _points_bin) if suffix == ".bin" else (_cameras_txt, _images_txt, _points_txt)
    return tuple(_whole(folder / f"{name}{suffix}", reader)
                 for name, reader in zip(("cameras", "images", "points3D"), readers, strict=True))


def _whole(path: Path, reader):
    try:
        return reader(path.read_bytes() if path.suffix == ".bin" else path.read_text())
    except (OSError, ValueError, struct.error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MiNtfError(f"{path}: cannot be read as part of a COLMAP model ({shown(str(reason))}); it needs cameras, "
                         "images and points3D, all .bin or all .txt: export it again with `colmap model_converter`"
                         ) from None


def _camera(model: str, width: int, height: int, params: tuple[float, ...]) -> Camera:
    if len(params) != MODELS[model] or not all(map(math.isfinite, params)):
        raise ValueError(f"camera model {model} has {MODELS[model]} finite parameters, found {params}")
    if not (0 < width < 1 << 20 and 0 < height < 1 << 20):
        raise ValueError(f"a camera of {width}x{height} pixels")
    return Camera(model, width, height, params)


def _image(name: str, camera: int, pose: tuple[float, ...]) -> Image:
    if not is_file_name(name):
        raise ValueError(f"an image's name is {shown(name)}")
    if not all(abs(v) < 1e30 for v in pose) or not 1e-12 < math.hypot(*pose[:4]):
        raise ValueError(f"the pose of image {shown(name)} is {pose}")
    return Image(name, camera, pose[:4], pose[4:])


def _points(rows: list[tuple[float, ...]]) -> np.ndarray:
    points = np.array(rows, np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise ValueError("a point is not finite")
    return points


# --- text -------------------------------------------------------------------------------------------------------------


def _rows(text: str, least: int, step: int = 1) -> list[list[str]]:
    """The words of every line, at `step` 2 of every other one; comments and empty lines before it are left out."""
    found, lines = [], iter(text.split("\n"))
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < least:
            raise ValueError(f"the line {shown(line)} has {len(words)} words, expected {least} or more")
        found.append(words)
        for _ in range(step - 1):
            next(lines, None)
    return found


def _cameras_txt(text: str) -> dict[int, Camera]:
    cameras = {}
    for number, model, width, height, *params in _rows(text, 4):
        if model not in MODELS:
            raise ValueError(f"unknown camera model {model}")
        cameras[int(number)] = _camera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _images_txt(text: str) -> list[Image]:
    return [_image(" ".join(words[9:]), int(words[8]), tuple(map(float, words[1:8]))) for words in _rows(text, 10, 2)]


def _points_txt(text: str) -> np.ndarray:
    return _points([tuple(map(float, (words[1], words[2], words[3]))) for words in _rows(text, 4)])


# --- binary: little-endian, counts before items -----------------------------------------------------------------------


class _Bytes:
    """Reads on and on; `struct` raises beyond the end, so counts that lie end there."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def count(self) -> int:
        return self.take("Q")[0]

    def name(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode()
        self.at = end + 1
        return text

    def skip(self, count: int, size: int) -> None:
        self.at += count * size
        if self.at > len(self.data):
            raise ValueError("it ends too early")


def _cameras_bin(data: bytes) -> dict[int, Camera]:
    stream, cameras, names = _Bytes(data), {}, list(MODELS)
    for _ in range(stream.count()):
        number, model, width, height = stream.take("IiQQ")
        if not 0 <= model < len(names):
            raise ValueError(f"unknown camera model {model}")
        cameras[number] = _camera(names[model], width, height, stream.take(f"{MODELS[names[model]]}d"))
    return cameras


def _images_bin(data: bytes) -> list[Image]:
    stream, images = _Bytes(data), []
    for _ in range(stream.count()):
        _, *pose, camera = stream.take("I7dI")
        images.append(_image(stream.name(), camera, tuple(pose)))
        stream.skip(stream.count(), 24)
    return images


def _points_bin(data: bytes) -> np.ndarray:
    stream = _Bytes(data)
    rows: list[tuple[float, ...]] = []
    for _ in range(stream.count()):
        _, x, y, z, _, _, _, _ = stream.take("Q3d3Bd")
        rows.append((x, y, z))
        stream.skip(stream.count(), 8)
    return _points(rows)
