"""Files that are whole or not there: written under another name in their folder, then put in their place.

Neither an error, nor a full disk, nor ``kill -9`` leaves half a file under the final name.
"""

import glob
import os
import platform
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import MiNtfError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary name to write to, for libraries that want one; the block holds nothing but the writing.

    At its end the file is complete on the disk and takes the place of `path`. Where the block fails nothing is left
    behind and `path` stays as it was; MiNtfError names `path` and what the system said.
    """
    path = Path(path)
    temporary = _temporary(path)
    try:
        tidy(path)
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError | RuntimeError):
            raise _fault(path, error) from None
        raise


def write(path: str | Path, *content) -> None:
    """Write `path`: `content` one after the other, text (UTF-8) or anything with bytes. Raises MiNtfError, see
    :func:`replacing`."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        for part in content:
            file.write(part.encode() if isinstance(part, str) else part)


def check(path: str | Path) -> None:
    """Raise the MiNtfError of a place that cannot be written to, before the work whose result belongs there."""
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        _temporary(path).touch()
        _temporary(path).unlink()
    except OSError as error:
        raise _fault(path, error) from None


def make_folder(path: str | Path) -> None:
    """Make the folder `path` and those above it, where they are missing. Raises MiNtfError."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MiNtfError(f"cannot make the folder {path} ({error.strerror}); choose another place") from None


def tidy(path: str | Path) -> None:
    """Remove what processes of this machine that were killed while they wrote `path` left beside it."""
    for found in Path(path).parent.glob(glob.escape(f"{Path(path).name}.{platform.node()}-") + "*.part"):
        number = found.name.split("-")[-1].removesuffix(".part")
        if number.isdecimal() and not _alive(int(number)):
            found.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    """Name of this thread alone: several threads and processes may write one file at a time."""
    return path.with_name(f"{path.name}.{platform.node()}-{threading.get_native_id()}-{os.getpid()}.part")


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _fault(path: Path, error: Exception) -> MiNtfError:
    folder = path.absolute().parent
    if not folder.exists():
        return MiNtfError(f"cannot write {path}: folder {path.parent} does not exist; create it first")
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).rstrip(".")
    return MiNtfError(f"cannot write {path} ({reason}); free space there or choose another place")
