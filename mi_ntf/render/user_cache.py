"""The user's cache: ``$XDG_CACHE_HOME/mi-ntf``, by default ``~/.cache/mi-ntf``.

What is lost there costs time alone. So nothing here raises: a folder that cannot be read or written is one warning, and
the render goes on.
"""

import os
from pathlib import Path

import mitsuba as mi

from ..core import files
from ..core.errors import MiNtfError

_warned: set[Path | None] = set()
"""Folders that were complained of."""


def folder() -> Path | None:
    """Where the cache is, whether or not it exists; None for users without a home."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(base or Path.home() / ".cache") / "mi-ntf"
    except RuntimeError:
        return None


def read(name: str, size: int | None = None) -> bytes | None:
    """The bytes of file `name`; None where it is missing, unreadable, or not of `size` bytes."""
    where = folder()
    if where is None:
        return None
    path = where / name
    try:
        if not path.is_file() or size not in (None, path.stat().st_size):
            return None
        return path.read_bytes()
    except OSError as error:
        _warn(where, f"cannot read {path} ({error.strerror})")
        return None


def write(name: str, *content) -> bool:
    """Keep `content` (:func:`mi_ntf.core.files.write`) as file `name`; whether that could be done."""
    where = folder()
    if where is None:
        _warn(where, "the user has no home folder")
        return False
    try:
        files.make_folder((where / name).parent)
        files.write(where / name, *content)
    except MiNtfError as error:
        _warn(where, str(error))
        return False
    return True


def _warn(where: Path | None, reason: str) -> None:
    """Once for each folder."""
    if where not in _warned:
        _warned.add(where)
        text = (f"mi_ntf keeps nothing for later renders: {reason}. XDG_CACHE_HOME names another folder, "
                "MI_NTF_MAP_CACHE=memory does without.")
        mi.Log(mi.LogLevel.Warn, text)  # type: ignore[operator]  # an object in the stub
