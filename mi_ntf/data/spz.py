"""Contents of ``.spz`` files of versions 1 to 3, the compressed splats of Niantic."""

import numpy as np

from ..core.errors import MiNtfError

MAGIC = b"NGSP"
VERSIONS = (1, 2, 3)
_HEADER = np.dtype([("magic", "S4"), ("version", "<u4"), ("count", "<u4"), ("degree", "u1"), ("bits", "u1"),
                    ("flags", "u1"), ("reserved", "u1")])
_COLOUR_SCALE = 0.15
_QUATERNION_BITS = 9


def columns(data: bytes, source: str) -> np.ndarray:
    """Return the splats (n, 14) of an unzipped file, in the order of :data:`mi_ntf.data.splat_files.COLUMNS`.

    Raises MiNtfError, whose text begins with `source`, if the data are damaged or of another version.
    """
    if len(data) < _HEADER.itemsize or data[:4] != MAGIC:
        raise MiNtfError(f"{source} is no .spz, or a damaged one; copy or export it again")
    header = np.frombuffer(data, _HEADER, 1)[0]
    version, count, bits = int(header["version"]), int(header["count"]), int(header["bits"])
    if version not in VERSIONS:
        raise MiNtfError(f"{source} is an .spz of version {version}, expected 1 to 3; export it as .ply")
    sizes = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3)
    if not count or bits > 23 or len(data) < _HEADER.itemsize + count * sum(sizes):
        raise MiNtfError(f"{source} is a damaged .spz: it announces {count} splats in {len(data)} bytes; copy or "
                         "export it again")
    parts, begin = [], _HEADER.itemsize
    for size in sizes:
        parts.append(np.frombuffer(data, np.uint8, count * size, begin).reshape(count, size))
        begin += count * size
    place, alpha, colour, scale, rotation = parts
    opacity = np.clip(alpha / 255.0, 1e-6, 1 - 1e-6)
    centres = place.copy().view("<f2").astype(np.float64) if version == 1 else _fixed(place) / 2.0**bits
    quaternion = _smallest_three(rotation) if version == 3 else _first_three(rotation)
    return np.concatenate([centres, (colour / 255.0 - 0.5) / _COLOUR_SCALE, np.log(opacity / (1 - opacity)),
                           scale / 16.0 - 10.0, quaternion], 1)


def _fixed(place: np.ndarray) -> np.ndarray:
    """Return signed integers (n, 3) of 24 bits each."""
    low, middle, high = np.moveaxis(place.reshape(-1, 3, 3).astype(np.int32), 2, 0)
    value = low | middle << 8 | high << 16
    return np.where(value >= 1 << 23, value - (1 << 24), value)


def _first_three(rotation: np.ndarray) -> np.ndarray:
    """Return quaternions, w first, of the bytes of x, y and z."""
    vector = rotation / 127.5 - 1.0
    real = np.sqrt(np.maximum(1 - (vector**2).sum(1, keepdims=True), 0))
    return np.concatenate([real, vector], 1)


def _smallest_three(rotation: np.ndarray) -> np.ndarray:
    """Return quaternions, w first, of the three smaller components, 10 bits each, and the number of the largest."""
    word = rotation.copy().view("<u4")[:, 0]
    largest = (word >> 30).astype(int)
    result = np.zeros((len(word), 4))  # x, y, z, w
    for component in (3, 2, 1, 0):
        other = largest != component
        mask = (1 << _QUATERNION_BITS) - 1
        size = (word & mask) / mask * np.sqrt(0.5)
        value = np.where(word >> _QUATERNION_BITS & 1, -size, size)
        result[:, component] = np.where(other, value, 0)
        word = np.where(other, word >> (_QUATERNION_BITS + 1), word)
    rest = np.sqrt(np.maximum(1 - (result**2).sum(1), 0))
    result[np.arange(len(word)), largest] = rest
    return result[:, [3, 0, 1, 2]]
