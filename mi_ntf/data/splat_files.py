"""Files of Gaussian splats: ``.ply`` of Gaussian splatting, and ``.spz`` of versions 1 to 3.

Both are read with NumPy alone. Their colours are those of photographs, sRGB, in the spherical harmonics of degree 0.
Higher degrees, which depend on the view, are left out.
"""

import gzip
import zlib
from pathlib import Path

import numpy as np

from ..core import ops, srgb
from ..core.errors import MiNtfError, shown
from ..core.splats import MAX_OPACITY, Splats
from . import spz

SUFFIXES = (".ply", ".spz")
"""Names of files of splats."""
BAND_0 = 0.28209479177387814
"""Spherical harmonic of degree 0, 1/√(4π)."""
COLUMNS = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
           "rot_0", "rot_1", "rot_2", "rot_3")
"""Properties of a splat: centre, harmonics of degree 0, logit of the opacity, logarithms of the scales, quaternion."""
MAX_HEADER = 1 << 16
"""Largest length of a header, bytes."""
LARGEST = 1e15
"""Largest coordinate that single precision can still square and sum."""
MAX_LOG_SCALE = 30.0
"""Largest absolute logarithm of a scale."""
_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
          "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
          "double": "f8", "float64": "f8"}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def read(path: str | Path) -> Splats:
    """Read a file of splats.

    Parameters
    ----------
    path
        A ``.ply`` as Gaussian splatting writes it (``x y z``, ``f_dc_*``, ``opacity``, ``scale_*``, ``rot_*``), or an
        ``.spz``.

    Returns
    -------
    Splats
        float32, in the coordinates of the file. Splats with a value that is not finite are left out.

    Raises
    ------
    MiNtfError
        If the file is missing, damaged, or of another form.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise MiNtfError(f"{path}: the name ends in {path.suffix!r}, expected {' or '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MiNtfError(f"cannot read {path} ({error.strerror}); give the name of a file of splats") from None
    if path.suffix.lower() == ".spz":
        return _splats(spz.columns(_unzipped(data, path), str(path)), path)
    return _splats(_ply_columns(data, path), path)


def _splats(columns: np.ndarray, path: Path) -> Splats:
    """Return the splats of `columns` (n, 14), in the order of ``COLUMNS``; raise MiNtfError if none is left."""
    with np.errstate(invalid="ignore", over="ignore"):
        columns = columns.astype(np.float64)
        norm = np.linalg.norm(columns[:, 10:14], axis=1, keepdims=True)
        good = np.isfinite(columns).all(1) & (norm[:, 0] > 1e-12) & (norm[:, 0] < LARGEST)
        good &= (np.abs(columns[:, :3]) < LARGEST).all(1)
        good &= (np.abs(columns[:, 7:10]) < MAX_LOG_SCALE).all(1)
    if not good.any():
        raise MiNtfError(f"{path}: none of its {len(columns)} splats has finite values and a rotation; "
                         "is it a file of Gaussian splatting?")
    columns, norm = columns[good], norm[good]
    opacity = 1 / (1 + np.exp(-np.clip(columns[:, 6], -30, 30)))
    colour = srgb.decode(ops, np.clip(0.5 + BAND_0 * columns[:, 3:6], 0, 1))
    return Splats(*(np.asarray(a, np.float32) for a in (
        columns[:, :3], np.exp(columns[:, 7:10]), columns[:, 10:14] / norm, np.minimum(opacity, MAX_OPACITY), colour)))


def _unzipped(data: bytes, path: Path) -> bytes:
    if data[:4] == spz.MAGIC:
        raise MiNtfError(f"{path} is an .spz of version 4 or newer, which this build does not read; "
                         "export it as .ply")
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error):
        raise MiNtfError(f"{path} is no .spz, or a damaged one; copy or export it again") from None


def _ply_columns(data: bytes, path: Path) -> np.ndarray:
    """Return ``COLUMNS`` (n, 14) of a PLY file."""
    order, count, properties, begin = _header(data, path)
    names = [name for name, _ in properties]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        packed = "; it is compressed, export it as an uncompressed .ply" if "packed_position" in names else (
            ", so it holds no Gaussian splats")
        raise MiNtfError(f"{path} has no property {', '.join(missing[:4])}{' …' * (len(missing) > 4)}{packed}")
    if not order:
        return _ascii(data[begin:], path, count, names)
    dtype = np.dtype([(name, order + kind) for name, kind in properties])
    if len(data) - begin < count * dtype.itemsize:
        raise MiNtfError(f"{path} ends after {(len(data) - begin) // dtype.itemsize} of {count} splats; "
                         "copy or export it again")
    table = np.frombuffer(data, dtype, count, begin)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.stack([table[name].astype(np.float32) for name in COLUMNS], 1)


def _ascii(body: bytes, path: Path, count: int, names: list[str]) -> np.ndarray:
    try:
        values = np.array(body.split()[: count * len(names)], np.float64).reshape(count, len(names))
    except ValueError:
        raise MiNtfError(f"{path} does not hold {count} splats of {len(names)} numbers; copy or export it again"
                         ) from None
    return values[:, [names.index(name) for name in COLUMNS]]


def _header(data: bytes, path: Path) -> tuple[str, int, list[tuple[str, str]], int]:
    """Return byte order ("" for text), number of vertices, their properties (name, type), and where they begin."""
    end = data.find(b"end_header", 0, MAX_HEADER)
    line_end = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise MiNtfError(f"{path} is no PLY file; give a .ply of Gaussian splatting")
    lines = [line.split() for line in data[:end].decode("latin-1").splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    try:
        (kind,) = (line[1] for line in lines if line[0] == "format")
        order = _ORDERS[kind]
        elements = [index for index, line in enumerate(lines) if line[0] == "element"]
        first = lines[elements[0]]
        if first[1] != "vertex":
            raise MiNtfError(f"{path}: the first element is {shown(first[1])}, expected vertex; export the splats "
                             "without other elements")
        count = int(first[2])
        if count < 1:
            raise MiNtfError(f"{path} has {count} splats, expected 1 or more")
        last = elements[1] if len(elements) > 1 else len(lines)
        properties = [(line[2], _TYPES[line[1]]) for line in lines[elements[0] + 1 : last]]
        if len({name for name, _ in properties}) != len(properties):
            raise ValueError
    except (ValueError, KeyError, IndexError) as error:
        if isinstance(error, MiNtfError):
            raise
        raise MiNtfError(f"{path}: the header is damaged, or describes lists; give a .ply of Gaussian splatting"
                         ) from None
    return order, count, properties, line_end + 1
