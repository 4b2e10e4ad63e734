"""The user's cache on disk: ``$XDG_CACHE_HOME/mi-ntf``, by default ``~/.cache/mi-ntf``.

An entry is a file of named arrays (safetensors), ``KIND/KEY.safetensors``: ``fields`` (baked volumes), ``patches``
(between which light bounces) and ``maps`` (transmittance). Its key covers all inputs of its content, the program text
included (:func:`key`). A hash of its content shows damage. The environment variable ``MI_NTF_CACHE`` is ``on``
(default), ``memory`` (no files) or ``off``.

Loss of an entry costs time alone. Nothing here raises, except for a wrong ``MI_NTF_CACHE``. A folder that cannot be
read or written causes one warning, and the render continues.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import safetensors.numpy

from ..core import files
from ..core.errors import MiNtfError
from . import log

LARGEST_FILE = 512 << 20
"""Bytes of the largest entry that is written."""
FOLDER_LIMIT = 2 << 30
"""Bytes of all entries, above which the least recently used ones are removed."""
KINDS = ("fields", "patches", "maps")
_SEAL = "seal"
_film = False
_warned: set[Path | None] = set()
"""Folders for which a warning was given."""


def mode() -> str:
    """Return the value of ``MI_NTF_CACHE``. Raises MiNtfError if it is another than ``on``, ``memory`` and ``off``."""
    value = os.environ.get("MI_NTF_CACHE", "on")
    if value not in ("on", "memory", "off"):
        raise MiNtfError(f'environment variable MI_NTF_CACHE is "{value}", expected on, memory or off')
    return value


@contextmanager
def switched(value: str) -> Iterator[None]:
    """Set ``MI_NTF_CACHE`` to `value` within the block."""
    before = os.environ.get("MI_NTF_CACHE")
    os.environ["MI_NTF_CACHE"] = value
    try:
        yield
    finally:
        os.environ.pop("MI_NTF_CACHE")
        if before is not None:
            os.environ["MI_NTF_CACHE"] = before


def folder() -> Path | None:
    """Return the cache's folder, which need not exist; None if the user has no home."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(base or Path.home() / ".cache") / "mi-ntf"
    except RuntimeError:
        return None


def key(*inputs: object) -> str:
    """Return the key of an entry with these inputs: arrays, or objects whose ``repr`` is their value.

    The program text that makes entries, the libraries and the variant are part of the key.
    """
    digest = hashlib.sha256(repr((_program(), _libraries(), mi.variant())).encode())
    for value in inputs:
        if isinstance(value, np.ndarray):
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


@lru_cache(maxsize=1)
def _program() -> str:
    """Return a hash of the modules that compute entries, so that no entry outlives a change of them."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for folder_name in ("core", "infer", "render/transport"):
        for file in sorted((package / folder_name).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _libraries() -> tuple[object, ...]:
    """Return the versions of the libraries, and of the compiler of the current variant."""
    compiler = dr.detail.cuda_version if str(mi.variant()).startswith("cuda") else dr.detail.llvm_version
    return *(vars(library)["__version__"] for library in (mi, dr, np)), compiler()


def cached(kind: str, name: str, make: Callable[[], dict[str, np.ndarray]], placed: bool = False
           ) -> dict[str, np.ndarray]:
    """Return the arrays of entry `name` of `kind`; call `make` and store its result if the entry is missing.

    `placed`: the arrays depend on places in the scene (:func:`film`).
    """
    on_disk = mode() == "on"
    arrays = read(kind, name) if on_disk else None
    if arrays is None:
        arrays = make()
        if on_disk:
            write(kind, name, arrays, placed)
    return arrays


@contextmanager
def film() -> Iterator[None]:
    """Write no entry within the block that depends on places, since moving objects would leave one for each frame."""
    global _film
    before, _film = _film, True
    try:
        yield
    finally:
        _film = before


def read(kind: str, name: str) -> dict[str, np.ndarray] | None:
    """Return the arrays of an entry; None if it is missing, unreadable or damaged."""
    path = _path(kind, name)
    if path is None or not path.is_file():
        return None
    try:
        with safetensors.safe_open(path, "np") as file:  # maps the file into memory
            arrays = {array: file.get_tensor(array) for array in file.keys()}  # no mapping
            seal = (file.metadata() or {}).get(_SEAL)
    except OSError as error:
        _warn(f"cannot read {path} ({error.strerror or error})")
        return None
    except Exception:  # the library raises many kinds for a damaged file
        return None
    if seal != _seal_of(kind, name, arrays):
        return None
    with suppress(OSError):
        os.utime(path)
    return arrays


def write(kind: str, name: str, arrays: dict[str, np.ndarray], placed: bool = False) -> None:
    """Write `arrays` as entry `name` of `kind`, unless they exceed ``LARGEST_FILE``; see :func:`cached`."""
    if (placed and _film) or sum(array.nbytes for array in arrays.values()) > LARGEST_FILE:
        return
    arrays = {k: np.ascontiguousarray(array) for k, array in arrays.items()}
    content = safetensors.numpy.save(arrays, {_SEAL: _seal_of(kind, name, arrays)})
    if _write(_path(kind, name), content):
        with suppress(OSError):  # other processes may remove entries at the same time
            _tidy()


def entries() -> Iterator[tuple[str, Path, os.stat_result]]:
    """Yield the kind, the file and its status of every entry on the disk."""
    base = folder()
    if base is None:
        return
    for kind in KINDS:
        for path in sorted((base / kind).glob("*")):
            with suppress(OSError):
                yield kind, path, path.stat()


def clear() -> int:
    """Remove every entry from the disk; return the number of bytes."""
    total = 0
    for _, path, status in entries():
        with suppress(OSError):
            path.unlink()
            total += status.st_size
    return total


def _path(kind: str, name: str) -> Path | None:
    base = folder()
    return base and base / kind / f"{name}.safetensors"


def _seal_of(kind: str, name: str, arrays: dict[str, np.ndarray]) -> str:
    """Return a hash of an entry's name and content."""
    digest = hashlib.sha256(f"{kind}/{name}".encode())
    for array_name, array in sorted(arrays.items()):
        digest.update(repr((array_name, array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _write(path: Path | None, content: bytes) -> bool:
    """Write a file; return True on success."""
    if path is None:
        _warn("the user has no home folder")
        return False
    try:
        files.make_folder(path.parent)
        files.write(path, content)
    except MiNtfError as error:
        _warn(str(error))
        return False
    return True


def _tidy() -> None:
    """Remove the least recently used entries until the folder is within its limit."""
    total = 0
    for _, path, status in sorted(entries(), key=lambda entry: entry[2].st_mtime, reverse=True):
        total += status.st_size
        if total > FOLDER_LIMIT:
            path.unlink(missing_ok=True)


def _warn(reason: str) -> None:
    """Warn once for each folder."""
    if folder() not in _warned:
        _warned.add(folder())
        log.warn(f"mi_ntf keeps nothing for later renders: {reason}. XDG_CACHE_HOME names another folder, "
                 "MI_NTF_CACHE=memory does without.")
