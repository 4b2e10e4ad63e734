"""The user's cache: ``$XDG_CACHE_HOME/mi-ntf``, by default ``~/.cache/mi-ntf``. What is made once is found there again.

An entry is a file of named arrays (safetensors), ``KIND/KEY.safetensors``: ``fields`` (baked volumes), ``patches``
(between which light bounces) and ``maps`` (transmittance). Its key depends on everything that its content does, the
program text included (:func:`key`); a hash of its content shows damage. The environment variable ``MI_NTF_CACHE``
switches: ``on`` (default), ``memory`` (no files), ``off``.

What is lost there costs time alone. So nothing here raises but for a wrong ``MI_NTF_CACHE``: a folder that cannot be
read or written is one warning, and the render goes on.
"""

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

LARGEST_FILE = 512 << 20
FOLDER_LIMIT = 2 << 30
"""Bytes: larger entries are not written; those used longest ago go when the folder is full."""
KINDS = ("fields", "patches", "maps")
_SEAL = "seal"
_film = False
_warned: set[Path | None] = set()
"""Folders that a warning was given for."""


def mode() -> str:
    """Return ``on``, ``memory`` or ``off``."""
    name = "MI_NTF_MAP_CACHE" if "MI_NTF_CACHE" not in os.environ else "MI_NTF_CACHE"  # its name in earlier builds
    value = os.environ.get(name, "on")
    if value not in ("on", "memory", "off"):
        raise MiNtfError(f'environment variable {name} is "{value}", expected on, memory or off')
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
    """Return the cache's folder, which need not exist; None for users without a home."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(base or Path.home() / ".cache") / "mi-ntf"
    except RuntimeError:
        return None


def key(*facts) -> str:
    """Return the key of what is made from the `facts`: arrays, or anything whose ``repr`` tells its value.

    The program text that makes entries, the libraries and the variant are part of it.
    """
    digest = hashlib.sha256(repr((_program(), _libraries(), mi.variant())).encode())
    for fact in facts:
        if isinstance(fact, np.ndarray):
            digest.update(np.ascontiguousarray(fact).data)
        else:
            digest.update(repr(fact).encode())
    return digest.hexdigest()


@lru_cache(maxsize=1)
def _program() -> str:
    """Return a hash of the modules that entries come from: none outlives a change of theirs."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for room in ("core", "infer", "render/transport"):
        for file in sorted((package / room).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _libraries() -> tuple:
    """Return the versions of what runs the program in the current variant."""
    compiler = dr.detail.cuda_version if str(mi.variant()).startswith("cuda") else dr.detail.llvm_version
    versions = mi.__version__, dr.__version__, np.__version__  # type: ignore[attr-defined]  # not in the stubs
    return *versions, compiler()


def kept(kind: str, name: str, make: Callable[[], dict[str, np.ndarray]], placed=False) -> dict[str, np.ndarray]:
    """Return the arrays of entry `name` of `kind`: from the disk, else of ``make()``, which are then kept there.

    `placed`: they depend on where things are in the scene (:func:`film`).
    """
    on_disk = mode() == "on"
    found = read(kind, name) if on_disk else None
    if found is None:
        found = make()
        if on_disk:
            write(kind, name, found, placed)
    return found


@contextmanager
def film() -> Iterator[None]:
    """Within, no entry is written that depends on places: what moves in a film would leave one for each frame."""
    global _film
    before, _film = _film, True
    try:
        yield
    finally:
        _film = before


def read(kind: str, name: str) -> dict[str, np.ndarray] | None:
    """Return the arrays of an entry; None where it is missing, unreadable or not what was written."""
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
    except Exception:  # of a damaged file, whatever the library makes of it
        return None
    if seal != _seal_of(kind, name, arrays):
        return None
    with suppress(OSError):
        os.utime(path)
    return arrays


def write(kind: str, name: str, arrays: dict[str, np.ndarray], placed: bool = False) -> None:
    """Keep `arrays` as entry `name` of `kind`, unless they are larger than ``LARGEST_FILE``; `placed`: as in
    :func:`kept`."""
    if (placed and _film) or sum(array.nbytes for array in arrays.values()) > LARGEST_FILE:
        return
    arrays = {k: np.ascontiguousarray(array) for k, array in arrays.items()}
    content = safetensors.numpy.save(arrays, {_SEAL: _seal_of(kind, name, arrays)})
    if _write(_path(kind, name), content):
        with suppress(OSError):  # of other processes that tidy up as well
            _tidy()


def entries() -> Iterator[tuple[str, Path, os.stat_result]]:
    """Yield the kind, the file and its status of every entry on the disk."""
    where = folder()
    for kind in KINDS if where else ():
        for path in sorted((where / kind).glob("*")):  # type: ignore[operator]
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
    where = folder()
    return where and where / kind / f"{name}.safetensors"


def _seal_of(kind: str, name: str, arrays: dict[str, np.ndarray]) -> str:
    """Return a hash of an entry's name and content."""
    digest = hashlib.sha256(f"{kind}/{name}".encode())
    for array_name, array in sorted(arrays.items()):
        digest.update(repr((array_name, array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _write(path: Path | None, content) -> bool:
    """Write a file; return True if that could be done."""
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
    """Remove the entries used longest ago until the folder is within its limit."""
    total = 0
    for _, path, status in sorted(entries(), key=lambda entry: entry[2].st_mtime, reverse=True):
        total += status.st_size
        if total > FOLDER_LIMIT:
            path.unlink(missing_ok=True)


def _warn(reason: str) -> None:
    """Warn once for each folder."""
    where = folder()
    if where not in _warned:
        _warned.add(where)
        text = (f"mi_ntf keeps nothing for later renders: {reason}. XDG_CACHE_HOME names another folder, "
                "MI_NTF_CACHE=memory does without.")
        mi.Log(mi.LogLevel.Warn, text)  # type: ignore[operator]  # an object in the stub
