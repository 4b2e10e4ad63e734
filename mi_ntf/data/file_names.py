r"""File names and text encodings as data sets write them, and the files on the disk that they mean.

A name is taken literally first. A photograph that is missing is then looked for with "/" in place of Windows' "\",
with its extension in another case, and with any other extension that is read if only one such file exists.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TypeGuard

from mi_ntf.core.errors import MiNtfError

SRGB_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")  # files of 8 bits
TIFF_SUFFIXES = (".tif", ".tiff")
SUFFIXES = (".png", ".exr", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")  # of several files the first is read


def is_file_name(name: object) -> TypeGuard[str]:
    """Return True if `name` could be the name of a file and can be shown in one line."""
    if not isinstance(name, str) or not name.isprintable():  # half a character is not printable either
        return False
    parts = [len(part.encode()) for part in name.split("/")]
    return 0 < sum(parts) <= 2000 and max(parts) <= 240


def photographs(files: Iterable[Path]) -> list[Path]:
    """Return those of the files, sorted, that are photographs by their names. Hidden files are none (`._IMG_1.jpg`)."""
    return sorted(path for path in files if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))


def is_absolute(name: str) -> bool:
    """Return True if `name` is absolute, here or on Windows."""
    return plain(name).startswith("/") or name[1:2] == ":"


def moved(folder: Path, name: str) -> str:
    """Return the last parts of an absolute `name` that are a file in `folder`, if the name itself is none."""
    if not is_absolute(name) or Path(name).is_file():
        return name
    parts = plain(name).split("/")
    tails = ("/".join(parts[i:]) for i in range(1, len(parts)))
    return next((tail for tail in tails if on_disk(folder / tail)), name)


def note_moved(names: list[str], current: list[str], source: Path) -> list[str]:
    """Return the assumption that the photographs `names` of the file `source` are now `current`, or nothing."""
    elsewhere = [name for name, now in zip(names, current, strict=True) if is_absolute(name) and not is_absolute(now)]
    return [f"{len(elsewhere)} photographs are not at the places that {source} names (first {elsewhere[0]}); those of "
            "the same names in the data set are read"] if elsewhere else []


def plain(name: str) -> str:
    """Return `name` with "/" between its parts."""
    return name.replace("\\", "/")


def locate(folder: Path, name: str) -> Path:
    """Return the photograph `name` in `folder`, or the path where it should be. Raises MiNtfError if two files fit."""
    place = folder / name
    if place.is_file():
        return place
    place = folder / plain(name)
    existing = on_disk(place)
    if existing is not None or place.suffix.lower() not in SUFFIXES:
        return existing or place
    candidates = [path for suffix in SUFFIXES if (path := on_disk(place.with_suffix(suffix)))]
    if len(candidates) > 1:
        raise MiNtfError(f"{place} does not exist, and {' and '.join(path.name for path in candidates)} lie there; "
                         "leave the one that is meant")
    return candidates[0] if candidates else place


def on_disk(place: Path) -> Path | None:
    """Return `place`, or else the file whose name differs from it by the case of the extension alone."""
    suffix = place.suffix
    for variant in dict.fromkeys((suffix, suffix.lower(), suffix.upper(), f".{suffix[1:].capitalize()}")):
        if suffix and (path := place.with_suffix(variant)).is_file():
            return path
    return place if place.is_file() else None


def first(places: Iterable[Path]) -> Path | None:
    """Return the first of `places` that is on the disk."""
    return next((path for place in places if (path := on_disk(place))), None)


def mask_places(masks: Path, name: str) -> list[Path]:
    """Return the possible paths of the mask of photograph `name` in the folder `masks`.

    A mask has the photograph's name as a PNG file, the name that COLMAP writes (name.jpg.png), that of Metashape
    (name_mask.png) or RealityCapture (name.mask.png), or another suffix. A leading folder `images` (`images_4`) is
    dropped.
    """
    relative = Path(name)
    if relative.is_absolute() or not relative.name:
        return []
    if len(relative.parts) > 1 and re.fullmatch(r"images(_\d+)?", relative.parts[0]):
        relative = Path(*relative.parts[1:])
    base = masks / relative
    return [*(base.with_name(f"{stem}{end}.png") for end in ("", "_mask", ".mask") for stem in (base.stem, base.name)),
            *(base.with_suffix(suffix) for suffix in (*SRGB_SUFFIXES[1:], *TIFF_SUFFIXES))]


def read_text(path: Path) -> tuple[str, str | None]:
    """Return ``(text, assumption or None)`` of a file of unknown encoding. Raises OSError and UnicodeDecodeError."""
    text, note = decode_text(path.read_bytes())
    return text, note and f"{path}: {note}"


def decode_text(raw: bytes) -> tuple[str, str | None]:
    """Decode UTF-8, UTF-16 or UTF-32, with or without a byte-order mark, or else Latin-1.

    Returns ``(text, assumption or None)``. Raises UnicodeDecodeError.
    """
    encoding = json.detect_encoding(raw)  # by byte-order mark and zero bytes
    try:
        return raw.decode(encoding), None
    except UnicodeDecodeError:
        if not encoding.startswith("utf-8"):
            raise
        return raw.decode("latin-1"), "is no UTF-8 and is read as Latin-1"
