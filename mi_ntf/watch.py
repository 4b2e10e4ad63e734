"""`mi-ntf render --watch`: render again whenever a file of the scene changes, and show the picture in tev if it runs.

Files are looked at five times a second rather than by the system's notices (inotify): a scene has a dozen, and notices
do not come from network file systems, where clusters keep theirs.

The protocol of tev, the viewer of https://github.com/Tom94/tev, is spoken by its author's package `tevclient`.
"""

import socket
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf.core import errors, interruption
from mi_ntf.core.errors import MiNtfError

INTERVAL = 0.2
"""Seconds between two looks at the files."""
TEV = "127.0.0.1:14158"
"""Where tev listens unless it is told otherwise."""
TEV_TIMEOUT = 5.0
"""Seconds after which a viewer that does not take its picture is left alone."""

Stamps = dict[Path, tuple | None]


def watch(render: Callable[[Callable[[Path], None]], None], say: Callable[[str], None]) -> None:
    """Call `render`, again after every change of the files that it read, until Ctrl-C, which returns.

    `render(seen)` calls `seen(path)` for each file before it reads it. What it raises is said and waits for the next
    change, of the files of the last round that ended well, too.
    """
    files: Stamps = {}
    with interruption.noticed() as stopped:
        while not stopped.is_set():
            fresh: Stamps = {}
            begun = time.perf_counter()
            try:
                render(lambda path, fresh=fresh: fresh.setdefault(path, _stamp(path)))  # type: ignore[misc]
                files = fresh
                say(f"{time.perf_counter() - begun:.1f} s; watching {len(files)} files, Ctrl-C ends")
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


def _changed(files: Stamps) -> Stamps:
    """Wait until some of `files` differ from their stamps and all have come to rest; their new stamps."""
    last = files
    while True:
        now = {path: _stamp(path) for path in files}
        if now != files and now == last:
            return now
        last = now
        time.sleep(INTERVAL)


def _stamp(path: Path) -> tuple | None:
    """Tells one state of a file from another; None where there is none."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


class Tev:
    """Pictures for a running tev at `address` ("HOST:PORT"). Pixels are sent, not a path: tev may run elsewhere, at the
    other end of `ssh -R 14158:127.0.0.1:14158`. Raises MiNtfError where `address` is none."""

    def __init__(self, address: str, say: Callable[[str], None]):
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise MiNtfError(f"--tev is {address!r}, expected HOST:PORT, as {TEV}")
        self._address, self._say, self._shown, self._told = (host, int(port)), say, set[str](), set[str]()

    def show(self, name: str, bitmap: Any) -> bool:
        """Send a Mitsuba bitmap under `name`, all channels; whether tev took it. Where none listens, that is no
        fault."""
        if not self._listens():
            return False
        try:
            import tevclient
        except ImportError:
            return self._tell("tev listens; it is sent pictures after `pip install 'mi-ntf[watch]'`")
        names = [field.name for field in bitmap.struct_()]
        pixels = np.array(bitmap, np.float32).reshape(bitmap.height(), bitmap.width(), len(names))
        timeout = socket.getdefaulttimeout()
        try:
            socket.setdefaulttimeout(TEV_TIMEOUT)  # tevclient opens its sockets with it
            with tevclient.Ipc(*self._address) as tev:
                tev.create_image(name, bitmap.width(), bitmap.height(), names, grab_focus=name not in self._shown)
                tev.update_image(name, pixels, names)
        except OSError as error:
            return self._tell(f"tev did not take the picture ({error})")
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

    def _tell(self, text: str) -> bool:
        """Say it once."""
        if text not in self._told:
            self._told.add(text)
            self._say(text)
        return False


def printed(text: str) -> None:
    """A line on the terminal, at once, apart from Mitsuba's own."""
    print(f"mi-ntf: {text}", file=sys.stderr, flush=True)
