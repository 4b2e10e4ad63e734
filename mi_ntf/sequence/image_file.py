"""Frames on disk: EXR files with a record of what they show, which is checked when they are read.

The record is JSON in the header's text ``mi_ntf_frame``: ``number``; ``of``, the frame's values; ``key``, a hash of all
that the pixels depend on (:func:`mi_ntf.sequence.work.key`); ``seal``, a hash of the other entries and of the pixels.
The record holds no time and no machine, so that the same frame is the same file.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import OpenEXR

from ..core import files
from ..core.errors import MiNtfError

HEADER_NAME = "mi_ntf_frame"
Channels: TypeAlias = Mapping[str, np.ndarray]
"""Arrays (h, w) by name, float16 or float32."""
Record: TypeAlias = dict[str, Any]


@dataclass(frozen=True)
class Fault:
    """Reason why a frame must be rendered: it is missing, unreadable, or shows another scene or other values."""

    kind: Literal["missing", "broken", "other"]
    text: str


def path_of(folder: Path, number: int, count: int) -> Path:
    """Return the path of frame `number` of `count` frames."""
    return Path(folder) / f"frame_{number:0{max(4, len(str(count - 1)))}}.exr"


def write(path: Path, channels: Channels, record: Record) -> None:
    """Write `channels` with `record`."""
    text = json.dumps(record | {"seal": _seal(channels, record)}, sort_keys=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, HEADER_NAME: text}
    files.make_folder(path.parent)
    with files.replacing(path) as temporary:
        OpenEXR.File(header, {name: np.ascontiguousarray(a) for name, a in channels.items()}).write(str(temporary))


def read(path: Path) -> tuple[Channels, Record]:
    """Return ``(channels, record)`` of a frame. Raises MiNtfError where the file is not as it was written."""
    printed = io.StringIO()  # OpenEXR prints what is wrong with pixels
    try:
        with redirect_stdout(printed), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            text = file.header().get(HEADER_NAME)
    except Exception as error:  # OpenEXR raises bare RuntimeError and ValueError
        why = printed.getvalue().rpartition(" - ")[2].strip() or str(error).strip() or type(error).__name__
        raise MiNtfError(f"{path} is no readable EXR ({why})") from None
    try:
        record = json.loads(text)
        intact = record.pop("seal") == _seal(channels, record)
    except (TypeError, ValueError, KeyError, AttributeError):
        raise MiNtfError(f"{path} does not say which frame it is: `mi-ntf sequence` has not written it") from None
    if not intact:
        raise MiNtfError(f"{path} holds other numbers than were written")
    return channels, record


def fault(path: Path, key: str) -> Fault | None:
    """Return the fault of the frame at `path`, None where it is intact and has this `key`."""
    if not path.is_file():
        return Fault("missing", f"{path} is missing")
    try:
        _, record = read(path)
    except MiNtfError as error:
        return Fault("broken", str(error))
    if record.get("key") != key:
        values = json.dumps(record.get("of", {}))
        values = values if len(values) < 200 else values[:197] + "..."
        return Fault("other", f"{path} shows another scene or other parameters, {values}")
    return None


def _seal(channels: Channels, record: Record) -> str:
    """Return the SHA-256 of the record and of names, sizes and numbers of the channels, hexadecimal."""
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    for name, pixels in sorted(channels.items()):
        digest.update(f"{name} {pixels.shape} {pixels.dtype.str};".encode())
        digest.update(np.ascontiguousarray(pixels).data)
    return digest.hexdigest()
