"""Reader of COLMAP models, text or binary.

The photographs are in `DIR/images`; the model is in `DIR/sparse/0`, `DIR/sparse` or `DIR`, or in `DIR/colmap` in place
of `DIR`. Of several models the one with most images is read. DIR may be the model's own folder with `images` in it or
up to three levels above. Masks are in `masks` beside `images`. Lens distortion is undone (`lens`), but fisheye cameras
are refused.

The files `rigs` and `frames` of newer models repeat the data of single cameras and are ignored, and so are the points
of images, whose lines may be missing. Sources: COLMAP's documentation, "Output format" and "Camera Models", and
`src/colmap/sensor/models.h`.
"""

import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data import file_names
from mi_ntf.data.file_names import is_file_name, locate, mask_places, moved, photographs, plain
from mi_ntf.data.schema import Camera, DataSet, View, drop_missing

FORM = "COLMAP model"
MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}  # fmt: skip
"""Number of parameters of each camera model, in the order of the models' numbers in binary files."""
PARAMETERS = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2), "PINHOLE": (0, 1, 2, 3), "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4), "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7), "FULL_OPENCV": tuple(range(12)),
}
"""Index of fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3 to k6 among the parameters of a model that is read."""

T = TypeVar("T")


class StoredCamera(NamedTuple):
    """Camera of a model."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class StoredImage(NamedTuple):
    """Image of a model with its world-to-camera pose."""

    name: str
    camera: int
    quaternion: tuple[float, ...]  # w, x, y, z, not normalised
    translation: tuple[float, ...]


def models(folder: Path) -> list[Path]:
    """Return the folders that hold `cameras` and `images`, as .bin or .txt."""
    places = []
    for sparse in (folder / "sparse", folder / "colmap" / "sparse"):
        numbered = [place for place in sparse.iterdir() if place.is_dir()] if sparse.is_dir() else []
        places += [*sorted(numbered, key=lambda place: (len(place.name), place.name)), sparse]
    return [place for place in (*places, folder) if _suffix(place)]


def read(folder: Path) -> DataSet:
    """Read the posed photographs of the folder's model as one split, `train`, by name. Raises MiNtfError."""
    model, assumed = _largest(folder)
    suffix = _suffix(model)
    read_cameras, read_points = (_cameras_bin, _points_bin) if suffix == ".bin" else (_cameras_txt, _points_txt)
    cameras, images = _whole(model / f"cameras{suffix}", read_cameras, assumed), _images(model, assumed)
    place = model / f"points3D{suffix}"
    points = _whole(place, read_points, assumed) if place.is_file() else None
    if points is None:
        assumed.append(f"{model} has no points3D, so the object's place is not known from points")
    root = next((p for p in (folder, folder / "colmap", *list(folder.absolute().parents)[:3]) if (p / "images").is_dir()
                 ), None)
    if root is None:
        raise MiNtfError(f"{folder / 'images'} does not exist; put the photographs of the model {model} there")
    views = []
    images.sort(key=lambda i: i.name)
    for image in images:
        where = f"{model}, image '{image.name}'"
        if image.camera not in cameras:
            raise MiNtfError(f"{where}: there is no camera {image.camera}; export the model again with `colmap "
                             "model_converter`")
        camera = cameras[image.camera]
        name = moved(root / "images", image.name)
        within = not plain(name).startswith("images/") or (root / "images" / name).is_file()
        photograph, name = locate(root / "images" if within else root, name), plain(name)
        views.append(View(where, photograph, name, mask_places(root / "masks", name), _opengl(image),
                          _opencv(camera, f"{model}, camera {image.camera}"), (camera.width, camera.height)))
    if not views:
        raise MiNtfError(f"{model}: the model has no posed photograph; run `colmap mapper` again")
    assumed += file_names.note_moved([image.name for image in images], [view.name for view in views], model)
    splits, notes = drop_missing({"train": views})
    stored, posed = len(photographs((root / "images").rglob("*"))), len(splits["train"])
    notes += [f"{stored - posed} of {stored} photographs in {root / 'images'} have no pose and are left out"
              ] * (stored > posed)
    return DataSet(FORM, splits, None, points, notes, assumed)


def _largest(folder: Path) -> tuple[Path, list[str]]:
    """Return the folder's model with most images, the first of equal ones, and the assumption that it is meant."""
    candidates = models(folder)
    if len(candidates) == 1:
        return candidates[0], []
    counts = [len(_images(model, [])) for model in candidates]
    sizes = ", ".join(f"{model.relative_to(folder)} with {n}" for model, n in zip(candidates, counts, strict=True))
    model = candidates[counts.index(max(counts))]
    return model, [f"of {len(candidates)} COLMAP models the one with most photographs is read, {model} ({sizes}); name "
                   "a model's own folder to read another"]


def _opencv(camera: StoredCamera, where: str) -> Camera:
    """Return the camera as OpenCV has it. COLMAP's pixel coordinates begin at the corner, as ours do."""
    if camera.model not in PARAMETERS:
        raise MiNtfError(f"{where}: its model {camera.model} is not read ({', '.join(PARAMETERS)} are); run `colmap "
                         "image_undistorter` and train on its output folder (PINHOLE)")
    fx, fy, cx, cy, *bent = (camera.parameters[i] for i in PARAMETERS[camera.model])
    if min(fx, fy) <= 0:
        raise MiNtfError(f"{where}: its focal length is {min(fx, fy):g}, must be positive; run `colmap mapper` again")
    bent += [0.0] * (4 - len(bent))
    return Camera(fx, fy, cx, cy, tuple(bent) if any(bent) else ())


def _opengl(image: StoredImage) -> np.ndarray:
    """Return the OpenGL camera-to-world (4, 4) of a world-to-camera with OpenCV axes (x right, y down, z ahead)."""
    w, x, y, z = np.array(image.quaternion) / np.linalg.norm(image.quaternion)
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T * (1.0, -1.0, -1.0)
    c2w[:3, 3] = -rotation.T @ image.translation
    return c2w


def _suffix(folder: Path) -> str | None:
    """Return the suffix of the model's files, None if there is no model; binary files come first."""
    return next((s for s in (".bin", ".txt") if (folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file()
                 ), None)


def _images(model: Path, assumed: list[str]) -> list[StoredImage]:
    suffix = _suffix(model)
    return _whole(model / f"images{suffix}", _images_bin if suffix == ".bin" else _images_txt, assumed)


def _whole(path: Path, reader: "Callable[[str], T] | Callable[[bytes], T]", assumed: list[str]) -> T:
    """Read the file with `reader`; assumptions about its text are added to `assumed`. Raises MiNtfError."""
    try:
        content: Any = path.read_bytes()
        if path.suffix != ".bin":
            content, note = file_names.read_text(path)
            assumed += [note] if note else []
        return reader(content)
    except (OSError, ValueError, struct.error) as error:
        short = isinstance(error, struct.error)
        reason = error.strerror if isinstance(error, OSError) else "it ends too early" if short else error
        raise MiNtfError(f"{path}: cannot be read as part of a COLMAP model ({shown(str(reason))}); it needs cameras, "
                         "images and points3D, all .bin or all .txt: export it again with `colmap model_converter`"
                         ) from None


def _camera(model: str, width: int, height: int, parameters: tuple[float, ...]) -> StoredCamera:
    if len(parameters) != MODELS[model] or not all(map(math.isfinite, parameters)):
        raise ValueError(f"camera model {model} has {MODELS[model]} finite parameters, found {parameters}")
    if not (0 < width < 1 << 20 and 0 < height < 1 << 20):
        raise ValueError(f"a camera of {width}x{height} pixels")
    return StoredCamera(model, width, height, parameters)


def _image(name: str, camera: int, pose: tuple[float, ...]) -> StoredImage:
    if not is_file_name(name):
        raise ValueError(f"an image's name is {shown(name)}")
    if not all(abs(v) < 1e30 for v in pose) or not 1e-12 < math.hypot(*pose[:4]):
        raise ValueError(f"the pose of image {shown(name)} is {[round(v, 4) for v in pose]}")
    return StoredImage(name, camera, pose[:4], pose[4:])


def _points(rows: Iterator[tuple[float, ...]]) -> np.ndarray:
    points = np.array(list(rows), np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise ValueError("a point is not finite")
    return points


def _rows(text: str) -> Iterator[list[str]]:
    """Yield the words of every line but comments and empty ones."""
    return (_words(line, 4, -1) for line in text.split("\n") if not _is_comment(line))


def _is_comment(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def _words(line: str, least: int, splits: int) -> list[str]:
    words = line.split(maxsplit=splits)
    if len(words) < least:
        raise ValueError(f"the line {shown(line)} has {len(words)} words, expected {least} or more")
    return words


def _cameras_txt(text: str) -> dict[int, StoredCamera]:
    cameras = {}
    for number, model, width, height, *parameters in _rows(text):
        if model not in MODELS:
            raise ValueError(f"unknown camera model {model}")
        cameras[int(number)] = _camera(model, int(width), int(height), tuple(map(float, parameters)))
    return cameras


def _images_txt(text: str) -> list[StoredImage]:
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
    """Return True for triples of numbers (x, y, number of the point), of which the line of an image has none."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(map(math.isfinite, map(float, words[:12])))
    except ValueError:
        return False


def _points_txt(text: str) -> np.ndarray:
    return _points((float(words[1]), float(words[2]), float(words[3])) for words in _rows(text))


class _Bytes:
    """Cursor in a binary file: little-endian, counts before items. `struct` raises beyond the end."""

    def __init__(self, data: bytes):
        self.data, self.position = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self.data, self.position)
        self.position += struct.calcsize("<" + form)
        return values

    def count(self) -> int:
        return int(self.take("Q")[0])

    def name(self) -> str:
        end = self.data.index(b"\0", self.position)
        text = file_names.decode_text(self.data[self.position : end])[0]
        self.position = end + 1
        return text

    def skip(self, size: int) -> None:
        """Skip a count and as many items of `size` bytes."""
        count = self.count()
        self.position += size * count
        if self.position > len(self.data):
            raise ValueError("it ends too early")


def _cameras_bin(data: bytes) -> dict[int, StoredCamera]:
    stream, cameras, names = _Bytes(data), {}, list(MODELS)
    for _ in range(stream.count()):
        number, model, width, height = stream.take("IiQQ")
        if not 0 <= model < len(names):
            raise ValueError(f"unknown camera model {model}")
        cameras[number] = _camera(names[model], width, height, stream.take(f"{MODELS[names[model]]}d"))
    return cameras


def _images_bin(data: bytes) -> list[StoredImage]:
    stream, images = _Bytes(data), []
    for _ in range(stream.count()):
        _, *pose, camera = stream.take("I7dI")
        images.append(_image(stream.name(), camera, tuple(pose)))
        stream.skip(24)
    return images


def _points_bin(data: bytes) -> np.ndarray:
    stream = _Bytes(data)

    def rows() -> Iterator[tuple[float, ...]]:
        for _ in range(stream.count()):
            _, x, y, z, *_ = stream.take("Q3d3Bd")
            yield x, y, z
            stream.skip(8)

    return _points(rows())
