"""Frames on disk: EXR files that say what they show, written whole, checked when they are read.

The header's text ``mi_ntf_frame`` is JSON: ``number``; ``of``, the frame's own parameters; ``key``, a hash of all that
its pixels depend on (:func:`mi_ntf.sequence.work.key`); ``seal``, a hash of the rest and of the pixels; for parts
of a frame ``part`` and ``parts``. No time and no machine is in it: the same frame is the same file.
"""

import hashlib
import io
import json
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import OpenEXR

from ..core import files
from ..core.errors import MiNtfError

RECORD = "mi_ntf_frame"
MISSING, BROKEN, OTHER = "missing", "broken", "other"
"""What may be wrong with a frame: no file; none that can be read as it was written; one of other parameters."""


def path_of(folder: Path, number: int, count: int, part: int = 0, parts: int = 1) -> Path:
    """The file of frame `number` of `count`, or of one of its `parts` by lights."""
    width = max(4, len(str(count - 1)))
    suffix = f".lights{part + 1}of{parts}" if parts > 1 else ""
    return Path(folder) / f"frame_{number:0{width}}{suffix}.exr"


def write(path: Path, channels: dict[str, np.ndarray], record: dict) -> None:
    """Write `channels`, arrays (h, w) by name, float16 or float32, with `record`."""
    text = json.dumps(record | {"seal": _seal(channels, record)}, sort_keys=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, RECORD: text}
    files.make_folder(path.parent)
    with files.replacing(path) as temporary:
        OpenEXR.File(header, {name: np.ascontiguousarray(a) for name, a in channels.items()}).write(str(temporary))


def read(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """``(channels, record)`` of a frame. Raises MiNtfError where the file is not what was written."""
    warned = io.StringIO()  # OpenEXR prints what is wrong with pixels
    try:
        with redirect_stdout(warned), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            text = file.header().get(RECORD)
    except Exception as error:  # OpenEXR raises bare RuntimeError and ValueError
        why = warned.getvalue().rpartition(" - ")[2].strip() or str(error).strip() or type(error).__name__
        raise MiNtfError(f"{path} is no readable EXR ({why})") from None
    try:
        record = json.loads(text)
        whole = record.pop("seal") == _seal(channels, record)
    except (TypeError, ValueError, KeyError, AttributeError):
        raise MiNtfError(f"{path} does not say which frame it is: `mi-ntf sequence` has not written it") from None
    if not whole:
        raise MiNtfError(f"{path} holds other numbers than were written")
    return channels, record


def fault(path: Path, key: str, parts: int = 1) -> tuple[str, str] | None:
    """What is wrong with the frame at `path`, which should have this `key`: its kind and a sentence; None: nothing.
    `parts`: how many images a whole frame is the sum of."""
    if not path.is_file():
        return MISSING, f"{path} is missing"
    try:
        _, record = read(path)
    except MiNtfError as error:
        return BROKEN, str(error)
    if record.get("key") != key or record.get("parts", 1) != parts:
        own = json.dumps(record.get("of", {}))
        return OTHER, f"{path} shows another scene or other parameters, {own if len(own) < 200 else own[:197] + '...'}"
    return None


def _seal(channels: dict[str, np.ndarray], record: dict) -> str:
    """SHA-256 of the record and of names, sizes and numbers of the channels, hexadecimal."""
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    for name, pixels in sorted(channels.items()):
        digest.update(f"{name} {pixels.shape} {pixels.dtype.str};".encode())
        digest.update(np.ascontiguousarray(pixels).data)
    return digest.hexdigest()
