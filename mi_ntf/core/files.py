"""Atomic writing: a file is written under another name in its folder, then renamed.

Neither an error, nor a full disk, nor ``kill -9`` leaves half a file under the final name. Missing folders are made.
"""

import glob
import os
import platform
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import MiNtfError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name to write to; the block does nothing but the writing.

    At its end the file is complete on the disk and replaces `path`. If the block fails, the temporary file is removed
    and `path` stays as it was; MiNtfError names `path` and the system's message.
    """
    path = Path(path)
    temporary = _temporary(path)
    make_folder(path.parent)
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


def write(path: str | Path, *content: str | bytes | memoryview) -> None:
    """Write the parts of `content`, text (UTF-8) or bytes, to `path`; raise MiNtfError as :func:`replacing` does."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        for part in content:
            file.write(part.encode() if isinstance(part, str) else part)


def check(path: str | Path, suffixes: Sequence[str] = (), overwrite: bool = True) -> None:
    """Raise MiNtfError if `path` cannot be written to; to be called before the work whose result belongs there.

    Missing folders are made. With `suffixes`, such as (".ply", ".obj"), the name must end in one of them. Without
    `overwrite`, the value of a command's option ``--overwrite``, the file must not exist.
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        expected = " or ".join(filter(None, [", ".join(suffixes[:-1]), suffixes[-1]]))
        raise MiNtfError(f"{path}: the name ends in {path.suffix!r}, expected {expected}")
    if path.is_dir():
        raise MiNtfError(f"cannot write {path} (it is a folder); give the name of a file")
    if path.exists() and not overwrite:
        raise MiNtfError(f"{path} exists; choose another name, or add --overwrite to replace it")
    make_folder(path.parent)
    try:
        _temporary(path).touch()
        _temporary(path).unlink()
    except OSError as error:
        raise _fault(path, error) from None


def make_folder(path: str | Path) -> None:
    """Make the folder `path` and its parents where they are missing; raise MiNtfError if that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MiNtfError(f"cannot make the folder {path} ({error.strerror}); choose another place") from None


def tidy(path: str | Path) -> None:
    """Remove the temporary files of `path` that killed processes of this machine left."""
    for part in Path(path).parent.glob(glob.escape(f"{Path(path).name}.{platform.node()}-") + "*.part"):
        number = part.name.split("-")[-1].removesuffix(".part")
        if number.isdecimal() and not _alive(int(number)):
            part.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    """Return a name unique to this thread: several threads and processes may write one file at a time."""
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
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).rstrip(".")
    return MiNtfError(f"cannot write {path} ({reason}); free space there or choose another place")
