"""The user's cache: ``$XDG_CACHE_HOME/mi-ntf``, by default ``~/.cache/mi-ntf``.

What is lost there costs time alone. So nothing here raises: a folder that cannot be read or written is one warning, and
the render goes on.
"""

import os
from functools import lru_cache
from pathlib import Path

import mitsuba as mi

from ..core import files
from ..core.errors import MiNtfError


def folder() -> Path | None:
    """Where the cache is, whether or not it exists; None, and a warning, for users without a home."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(base or Path.home() / ".cache") / "mi-ntf"
    except RuntimeError as error:
        _warn(f"nothing is kept for later renders: {error} Set XDG_CACHE_HOME.")
        return None


def read(name: str, size: int | None = None) -> bytes | None:
    """The bytes of file `name`; None where it is missing, unreadable, or not of `size` bytes."""
    where = folder()
    try:
        if where is None or not (where / name).is_file() or size not in (None, (where / name).stat().st_size):
            return None
        return (where / name).read_bytes()
    except OSError as error:
        _warn(f"the cache cannot be read, and is made anew: {error}")
        return None


def write(name: str, *content) -> bool:
    """Keep `content` (:func:`mi_ntf.core.files.write`) as file `name`; whether that could be done."""
    where = folder()
    if where is None:
        return False
    try:
        files.make_folder((where / name).parent)
        files.write(where / name, *content)
    except MiNtfError as error:
        _warn(f"nothing is kept for later renders: {error}, or set XDG_CACHE_HOME.")
        return False
    return True


@lru_cache
def _warn(text: str) -> None:
    mi.Log(mi.LogLevel.Warn, text)
