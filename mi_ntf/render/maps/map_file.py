"""Transmittance maps as EXR, which ``mi-ntf bake`` writes and the integrator's ``map_file`` reads.

The file has one part per light, with channels ``a`` and ``b`` (one logistic) or ``w0 a0 b0 w1 a1 b1`` (mixtures; see
:mod:`mi_ntf.core.mixture`). They are float32, those of an atlas float16. Rows and columns are the light's rays as in
:mod:`mi_ntf.infer.visibility.light_rays`. The attribute ``mi_ntf`` of each part is JSON: the inputs of the map
(:func:`.map_cache.description`), the light's place in field coordinates and a hash of the texels.
"""

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR

from ...core import files
from ...core.errors import MiNtfError
from ...infer.lights import LightTable
from ...infer.texels import DTYPES
from ...infer.visibility.light_rays import COLUMNS, frames
from ...infer.visibility.method import Options
from ...infer.visibility.transmittance_map import TransmittanceMap
from ..scene.media import NRFMedium
from .map_cache import description

ATTRIBUTE = "mi_ntf"


def write(path: Path, medium: NRFMedium, lights: LightTable, options: Options, maps: Iterable[TransmittanceMap]
          ) -> None:
    """Write `maps`, which together are those of all `lights`, in order.

    Raises MiNtfError if the file cannot be written; no part of it is left then.
    """
    shapes = _shapes(medium, lights, options)
    window = np.zeros(2, np.int32), np.array(shapes, np.int32).max(0)[::-1] - 1
    parts: list[OpenEXR.Part] = []
    for tmap in maps:
        for values in tmap.values.reshape(tmap.count, -1, tmap.width):
            k = len(parts)
            lines, columns = shapes[k]
            texels = values[: lines * columns].reshape(lines, columns, tmap.width)
            record = description(medium, options) | _light(lights, k) | {"texels": _digest(texels)}
            header = {
                "name": f"light {k}", "type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION,
                "displayWindow": window, ATTRIBUTE: json.dumps(record),
            }
            channels = {name: np.ascontiguousarray(texels[..., c]) for c, name in _channels(tmap.width).items()}
            parts.append(OpenEXR.Part(header, channels))
    with files.replacing(path) as temporary:
        OpenEXR.File(parts).write(str(temporary))


def read(path: Path, medium: NRFMedium, lights: LightTable, options: Options, channels: int) -> np.ndarray:
    """Return the numbers of the map of `lights` in `path`, `channels` numbers per texel.

    Raises MiNtfError with the names of file and scene if the map is one of another field, of other lights or of other
    settings, or if the file is damaged.
    """
    if not path.is_file():
        raise MiNtfError(f"map_file {path} does not exist; make it with `mi-ntf bake SCENE.xml -o {path.name}`")
    headers = _parts(path, header_only=True)  # sizes are checked before memory is allocated for them
    if len(headers) != lights.total:
        raise MiNtfError(f"map_file {path} holds {len(headers)} lights, the scene has {lights.total}; bake it anew")
    run = slice(lights.first, lights.first + lights.count)
    shapes = _shapes(medium, lights, options)
    digests = []
    for k, (part, shape) in enumerate(zip(headers[run], shapes, strict=True)):
        record = part.record()
        part.compare(record, description(medium, options) | _light(lights, k))
        if part.size != shape:
            raise part.damaged(f"is {part.size} texels, expected {shape}")
        digests.append(record.get("texels"))
    largest = options.map_resolution**2
    for part in headers:
        if math.prod(part.size) * part.count > largest * max(channels, 4):
            raise part.damaged(f"is {part.size} texels of {part.count} channels")
    parts = _parts(path)
    if len(parts) != lights.total:  # the library leaves out those that it cannot read
        raise MiNtfError(f"map_file {path} is damaged: {len(parts)} of {lights.total} lights can be read; bake it anew")
    values = np.zeros((lights.count, largest, channels), DTYPES[options.half])
    for row, part, shape, digest in zip(values, parts[run], shapes, digests, strict=True):
        texels = part.texels(shape, channels, values.dtype)
        if _digest(texels) != digest:
            raise part.damaged("holds other texels than were written")
        row[: math.prod(shape)] = texels.reshape(-1, channels)
    return values.ravel()


@dataclass(frozen=True)
class _Part:
    """Part `index` of the file `path`: one light's header and channels."""

    path: Path
    index: int
    part: OpenEXR.Part

    @property
    def size(self) -> tuple[int, int]:
        """Lines and columns by the header."""
        (left, top), (right, bottom) = (corner.tolist() for corner in self.part.header["dataWindow"])
        return bottom - top + 1, right - left + 1

    @property
    def count(self) -> int:
        """Number of channels by the header."""
        return len(self.part.header["channels"])

    def damaged(self, fault: str) -> MiNtfError:
        """Return the error that names the `fault` of this part."""
        return MiNtfError(f"map_file {self.path}, light {self.index}: {fault}; the file is damaged, bake it anew")

    def record(self) -> dict[str, object]:
        """Return the content of the attribute ``mi_ntf``."""
        if ATTRIBUTE not in self.part.header:
            raise MiNtfError(f"map_file {self.path} is an EXR file of another program; make it with `mi-ntf bake`")
        try:
            record = json.loads(self.part.header[ATTRIBUTE])
        except (TypeError, ValueError, RecursionError):
            record = None
        if not isinstance(record, dict):
            raise self.damaged(f"its attribute {ATTRIBUTE} is no JSON object")
        return record

    def compare(self, record: dict[str, object], expected: dict[str, object]) -> None:
        """Raise MiNtfError if an entry of `record` is not the expected one."""
        for name, value in expected.items():
            if not _same(record.get(name), value):
                raise MiNtfError(f"map_file {self.path}, light {self.index}: {name} is {str(record.get(name))[:80]}, "
                                 f"the scene's is {value}; bake it anew or render with the settings it was baked with")

    def texels(self, shape: tuple[int, int], channels: int, dtype: np.dtype) -> np.ndarray:
        """Return the texels, (lines, columns, channels)."""
        names = _channels(channels)
        if set(self.part.channels) != set(names.values()):
            raise self.damaged(f"has channels {', '.join(sorted(self.part.channels))}, "
                               f"expected {', '.join(names.values())}")
        texels = np.zeros((*shape, channels), dtype)
        for c, name in names.items():
            pixels = self.part.channels[name].pixels
            if pixels.shape != shape or pixels.dtype != dtype:
                raise self.damaged(f"channel {name} is {pixels.dtype} of shape {pixels.shape}")
            texels[..., c] = pixels
        return texels


def _parts(path: Path, header_only: bool = False) -> list[_Part]:
    try:
        parts = OpenEXR.File(str(path), header_only=header_only).parts
    except Exception as error:  # the library has many kinds
        raise MiNtfError(f"map_file {path} is no EXR file ({error}); make it with `mi-ntf bake`") from None
    return [_Part(path, k, part) for k, part in enumerate(parts)]


def _digest(texels: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(texels, texels.dtype.newbyteorder("<")).data).hexdigest()


def _same(a: object, b: object) -> bool:
    """Return True if both have one type and value; floating-point numbers may differ by rounding."""
    if type(a) is not type(b):
        return False
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-6)
    return a == b


def _light(lights: LightTable, k: int) -> dict[str, object]:
    return {"kind": "point" if lights.is_point[k] else "directional", "where": lights.where[k].tolist()}


def _shapes(medium: NRFMedium, lights: LightTable, options: Options) -> list[tuple[int, int]]:
    """Return the lines and columns of each light's map."""
    columns = frames(lights, medium.field.grid.hull, options.map_resolution)[:, COLUMNS]
    return [(int((options.map_resolution**2 + 0.5) // n), int(n)) for n in columns]


def _channels(count: int) -> dict[int, str]:
    """Return the channel name of each number of a texel that is stored: index → name."""
    if count == 2:
        return {0: "a", 1: "b"}
    return {4 * k + j: f"{name}{k}" for k in range(count // 4) for j, name in enumerate("wab")}
