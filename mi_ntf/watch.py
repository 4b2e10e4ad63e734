"""`mi-ntf render --watch`: render again whenever a file of the scene changes, and show the picture in tev if it runs.

Files are polled, since the system's notices (inotify) do not come from network file systems. Pictures are sent by the
package `tevclient` of the author of tev (https://github.com/Tom94/tev).
"""

import socket
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mi_ntf.core import errors, extras, interruption
from mi_ntf.core.errors import MiNtfError

if TYPE_CHECKING:
    import mitsuba as mi

INTERVAL = 0.2
"""Seconds between two checks of the files."""
TEV = "127.0.0.1:14158"
"""Default address of tev."""
TEV_TIMEOUT = 5.0
"""Seconds that tev may take to receive a picture."""

Stamp = tuple[int, int, int] | None
"""Time of change, size and inode of a file. None if it does not exist."""
Stamps = dict[Path, Stamp]


def watch(render: Callable[[Callable[[Path], None]], None], say: Callable[[str], None]) -> None:
    """Call `render`, and again after every change of the files that it read, until Ctrl-C.

    `render(note)` calls `note(path)` for each file before it reads it. Its errors are printed by `say`. After an error,
    the files of the last successful round are watched, too.
    """
    files: Stamps = {}
    with interruption.noticed() as stopped:
        while not stopped.is_set():
            fresh: Stamps = {}
            begin = time.perf_counter()
            try:
                render(partial(_note, fresh))
                files = fresh
                say(f"{time.perf_counter() - begin:.1f} s; watching {len(files)} files, Ctrl-C ends")
            except KeyboardInterrupt:
                return
            except Exception as error:
                if stopped.is_set():  # Mitsuba wraps an interruption in an error of its own
                    return
                if errors.debug():
                    traceback.print_exc()
                files |= fresh
                say(f"error: {errors.sentence(error)}; watching {len(files)} files, Ctrl-C ends")
            try:
                files = _changed(files)
            except KeyboardInterrupt:
                return


def _note(stamps: Stamps, path: Path) -> None:
    stamps.setdefault(path, _stamp(path))


def _changed(files: Stamps) -> Stamps:
    """Wait until some of `files` differ from their stamps and none changes any more, and return the new stamps."""
    last = files
    while True:
        now = {path: _stamp(path) for path in files}
        if now != files and now == last:
            return now
        last = now
        time.sleep(INTERVAL)


def _stamp(path: Path) -> Stamp:
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


class Tev:
    """Connection to a running tev at `address` ("HOST:PORT").

    Pixels are sent, not a path, because tev may run on another machine, at the end of `ssh -R 14158:127.0.0.1:14158`.
    Raises MiNtfError for a malformed `address`.
    """

    def __init__(self, address: str, say: Callable[[str], None]) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise MiNtfError(f"--tev is {address!r}, expected HOST:PORT, as {TEV}")
        self._address, self._say = (host, int(port)), say
        self._shown, self._messages = set[str](), set[str]()

    def show(self, name: str, bitmap: "mi.Bitmap") -> bool:
        """Send all channels of a bitmap under `name`. Return False if tev does not listen or take the picture."""
        if not self._listens():
            return False
        if extras.missing("watch"):
            return self._say_once("tev listens; it is sent pictures after `pip install 'mi-ntf[watch]'`")
        import tevclient

        names = [field.name for field in bitmap.struct_()]  # type: ignore[attr-defined]  # not in the stub
        pixels = np.array(bitmap, np.float32).reshape(bitmap.height(), bitmap.width(), len(names))
        timeout = socket.getdefaulttimeout()
        try:
            socket.setdefaulttimeout(TEV_TIMEOUT)  # tevclient opens its sockets with it
            with tevclient.Ipc(*self._address) as tev:
                tev.create_image(name, bitmap.width(), bitmap.height(), names, grab_focus=name not in self._shown)
                tev.update_image(name, pixels, names)
        except OSError as error:
            return self._say_once(f"tev did not take the picture ({error})")
        finally:
            socket.setdefaulttimeout(timeout)
        self._shown.add(name)
        return True

    def _listens(self) -> bool:
        try:
            socket.create_connection(self._address, 0.5).close()
        except OSError:
            self._shown.clear()
            return False
        return True

    def _say_once(self, text: str) -> bool:
        if text not in self._messages:
            self._messages.add(text)
            self._say(text)
        return False


def printed(text: str) -> None:
    """Print a line on standard error at once."""
    print(f"mi-ntf: {text}", file=sys.stderr, flush=True)
