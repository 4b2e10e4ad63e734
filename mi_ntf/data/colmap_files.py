"""The three files of a COLMAP model, text or binary, read within their own length.

Source of the forms: COLMAP's documentation, "Output format". The files `rigs` and `frames` of newer models repeat what
`images` says of single cameras and are left aside, and so are the images' points: their lines may be missing.
"""

import math
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import text as texts
from mi_ntf.data.file_names import is_file_name

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


def suffix(folder: Path) -> str | None:
    """The extension of the model's files in `folder`, None where there is no model; binary files come first."""
    return next((s for s in (".bin", ".txt") if (folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file()
                 ), None)


class Model(NamedTuple):
    cameras: dict[int, Camera]
    images: list[Image]
    points: np.ndarray | None
    """(P, 3), None where the model has no file of points."""
    assumed: list[str]


def read(folder: Path) -> Model:
    """The model in `folder`. Raises MiNtfError, with the file's name, where one is not what COLMAP writes."""
    assumed: list[str] = []
    form = suffix(folder)
    of_cameras, of_images, of_points = (
        (_cameras_bin, _images_bin, _points_bin) if form == ".bin" else (_cameras_txt, _images_txt, _points_txt))
    place = folder / f"points3D{form}"
    return Model(_whole(folder / f"cameras{form}", of_cameras, assumed),
                 _whole(folder / f"images{form}", of_images, assumed),
                 _whole(place, of_points, assumed) if place.is_file() else None, assumed)


def count(folder: Path) -> int:
    """Return the number of images of the model in `folder`. Raises MiNtfError."""
    form = suffix(folder)
    return len(_whole(folder / f"images{form}", _images_bin if form == ".bin" else _images_txt, []))


def _whole(path: Path, reader, assumed: list[str]):
    """Read the file by `reader`; assumptions about its text are added to `assumed`."""
    try:
        if path.suffix == ".bin":
            return reader(path.read_bytes())
        text, note = texts.read(path)
        assumed += [note] if note else []
        return reader(text)
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


def _rows(text: str, least: int) -> list[list[str]]:
    """The words of every line but comments and empty ones."""
    return [_words(line, least, -1) for line in text.split("\n") if not _is_comment(line)]


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def _words(line: str, least: int, splits: int) -> list[str]:
    words = line.split(maxsplit=splits)
    if len(words) < least:
        raise ValueError(f"the line {shown(line)} has {len(words)} words, expected {least} or more")
    return words


def _cameras_txt(text: str) -> dict[int, Camera]:
    cameras = {}
    for number, model, width, height, *params in _rows(text, 4):
        if model not in MODELS:
            raise ValueError(f"unknown camera model {model}")
        cameras[int(number)] = _camera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _images_txt(text: str) -> list[Image]:
    """Read the line of each image. The line of points after it may be empty or missing, as some programs leave it."""
    images, points_may_follow = [], False
    for line in text.split("\n"):
        if points_may_follow and _is_points(line):
            points_may_follow = False
        elif not _is_comment(line):
            words = _words(line, 10, 9)  # the last is the name, with the spaces in it
            images.append(_image(words[9].rstrip(), int(words[8]), tuple(map(float, words[1:8]))))
            points_may_follow = True
    return images


def _is_points(line: str) -> bool:
    """Return True if the line is empty or consists of triples of numbers: x, y, number of the point.

    The line of an image does not: its tenth word is a name.
    """
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(map(math.isfinite, map(float, words[:12])))
    except ValueError:
        return False


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
        text = texts.decode(self.data[self.at : end])[0]
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
