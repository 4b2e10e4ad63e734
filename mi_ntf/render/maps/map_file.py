"""Transmittance maps as EXR: ``mi-ntf bake``, and the integrator's ``map_file``.

A multi-part file, one part a light, channels ``a`` and ``b`` (one logistic) or ``w0 a0 b0 w1 a1 b1`` (mixtures;
see :mod:`mi_ntf.core.mixture`), float32, an atlas's of half precision, the light's rays along rows and columns as in
:mod:`mi_ntf.infer.visibility.light_rays`. The attribute ``mi_ntf`` of each part is JSON: the field's hash, the light's
place in field coordinates, how the map was made and a hash of its texels.
"""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import OpenEXR

from ...core import files
from ...core.errors import MiNtfError
from ...infer.texels import DTYPES
from ...infer.visibility.light_rays import frames

ATTRIBUTE = "mi_ntf"


def write(path: Path, medium, table, options, maps) -> None:
    """Write `maps`, one after the other those of all lights of `table`. Raises MiNtfError, and leaves no half file,
    where that cannot be done."""
    shapes = [_shape(row, options.map_resolution)
              for row in frames(table, medium.field.grid.hull, options.map_resolution)]
    window = np.zeros(2, np.int32), np.array(shapes, np.int32).max(0)[::-1] - 1
    parts: list = []
    for tmap in maps:
        for values in tmap.values.reshape(tmap.count, -1, tmap.width):
            k = len(parts)
            lines, columns = shapes[k]
            texels = values[: lines * columns].reshape(lines, columns, tmap.width)
            about = _description(medium, options) | _light(table, k) | {"texels": _digest(texels)}
            header = {
                "name": f"light {k}", "type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION,
                "displayWindow": window, ATTRIBUTE: json.dumps(about),
            }
            channels = {name: np.ascontiguousarray(texels[..., c]) for c, name in _names(tmap.width).items()}
            parts.append(OpenEXR.Part(header, channels))
    with files.replacing(path) as temporary:
        OpenEXR.File(parts).write(str(temporary))


def read(path: Path, medium, table, options, width: int) -> np.ndarray:
    """The numbers of the map that `path` holds, for a :class:`TransmittanceMap` of `table`'s lights, `width` a texel.

    Raises MiNtfError, naming file and scene, where it was made from another field, for other lights or with other
    settings, or where it does not hold what was written.
    """
    if not path.is_file():
        raise MiNtfError(f"map_file {path} does not exist; make it with `mi-ntf bake SCENE.xml -o {path.name}`")
    headers = _parts(path, header_only=True)  # sizes are judged before memory is taken for them
    if len(headers) != table.total:
        raise MiNtfError(f"map_file {path} holds {len(headers)} lights, the scene has {table.total}; bake it anew")
    mine = slice(table.first, table.first + table.count)
    shapes = [_shape(row, options.map_resolution)
              for row in frames(table, medium.field.grid.hull, options.map_resolution)]
    digests = []
    for k, (part, shape) in enumerate(zip(headers[mine], shapes, strict=True)):
        about = _about(path, k, part)
        _compare(path, k, about, _description(medium, options) | _light(table, k))
        if _size(part) != shape:
            raise _damaged(path, k, f"is {_size(part)} texels, expected {shape}")
        digests.append(about.get("texels"))
    largest = options.map_resolution**2
    for k, part in enumerate(headers):
        if math.prod(_size(part)) * len(part.header["channels"]) > largest * max(width, 4):
            raise _damaged(path, k, f"is {_size(part)} texels of {len(part.header['channels'])} channels")
    parts = _parts(path)
    if len(parts) != table.total:  # the library leaves out those that it cannot read
        raise MiNtfError(f"map_file {path} is damaged: {len(parts)} of {table.total} lights can be read; bake it anew")
    values = np.zeros((table.count, largest, width), DTYPES[options.half])
    for k, (part, digest) in enumerate(zip(parts[mine], digests, strict=True)):
        texels = _texels(path, k, part, shapes[k], values)
        if _digest(texels) != digest:
            raise _damaged(path, k, "holds other texels than were written")
        values[k, : shapes[k][0] * shapes[k][1]] = texels.reshape(-1, width)
    return values.ravel()


def _parts(path: Path, header_only: bool = False) -> list:
    try:
        return OpenEXR.File(str(path), header_only=header_only).parts
    except Exception as error:  # the library has many kinds
        raise MiNtfError(f"map_file {path} is no EXR file ({error}); make it with `mi-ntf bake`") from None


def _size(part) -> tuple[int, int]:
    """Lines and columns, by the header."""
    (left, top), (right, bottom) = (corner.tolist() for corner in part.header["dataWindow"])
    return bottom - top + 1, right - left + 1


def _damaged(path: Path, k: int, fault: str) -> MiNtfError:
    return MiNtfError(f"map_file {path}, light {k}: {fault}; the file is damaged, bake it anew")


def _about(path: Path, k: int, part) -> dict:
    """The attribute of light `k`."""
    if ATTRIBUTE not in part.header:
        raise MiNtfError(f"map_file {path} is an EXR file of another program; make it with `mi-ntf bake`")
    try:
        found = json.loads(part.header[ATTRIBUTE])
    except (TypeError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise _damaged(path, k, f"its attribute {ATTRIBUTE} is no JSON object")
    return found


def _texels(path: Path, k: int, part, shape: tuple[int, int], like: np.ndarray) -> np.ndarray:
    """(lines, columns, width) numbers, as wide and of the type as `like`."""
    names = _names(like.shape[-1])
    if set(part.channels) != set(names.values()):
        raise _damaged(path, k, f"has channels {', '.join(sorted(part.channels))}, expected "
                                + ", ".join(names.values()))
    texels = np.zeros((*shape, like.shape[-1]), like.dtype)
    for c, name in names.items():
        pixels = part.channels[name].pixels
        if pixels.shape != shape or pixels.dtype != like.dtype:
            raise _damaged(path, k, f"channel {name} is {pixels.dtype} of shape {pixels.shape}")
        texels[..., c] = pixels
    return texels


def _digest(texels: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(texels, texels.dtype.newbyteorder("<")).data).hexdigest()


def _compare(path: Path, k: int, found: dict, wanted: dict) -> None:
    for name, value in wanted.items():
        other = found.get(name)
        if not _same(other, value):
            raise MiNtfError(f"map_file {path}, light {k}: {name} is {str(other)[:80]}, the scene's is {value}; "
                             "bake it anew or render with the settings it was baked with")


def _same(a, b) -> bool:
    """Alike in type and value; floating point up to rounding."""
    if type(a) is not type(b):
        return False
    if isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-6) if isinstance(b, float) else a == b


def components(medium, options) -> int:
    return medium.field.network.components if options.map_source == "network" else options.map_components


def _description(medium, options) -> dict:
    return {"field": medium.field.digest, "representation": medium.representation,
            "grid": medium.field.grid.resolution, "map_resolution": options.map_resolution,
            "map_source": options.map_source, "map_components": components(medium, options),
            "samples": 2 / options.step}


def _light(table, k: int) -> dict:
    return {"kind": "point" if table.is_point[k] else "directional", "where": table.where[k].tolist()}


def _shape(row: np.ndarray, resolution: int) -> tuple[int, int]:
    """Lines and columns of the map of a light with this row."""
    return int((resolution**2 + 0.5) // row[11]), int(row[11])


def _names(width: int) -> dict[int, str]:
    """Place in a texel → channel."""
    if width == 2:
        return {0: "a", 1: "b"}
    return {4 * k + j: f"{name}{k}" for k in range(width // 4) for j, name in enumerate("wab")}
