"""Mitsuba's logger and file resolver.

The stock program shows messages from level Info on, Python from level Warn on.
"""

import time
from types import TracebackType

import drjit as dr
import mitsuba as mi

from ..core import progress, quantities

INTERVAL = 3.0
"""Seconds between two lines of progress. Shorter work shows none."""


def info(text: str) -> None:
    """Log a line at level Info."""
    _log(mi.LogLevel.Info, text)


def warn(text: str) -> None:
    """Log a line at level Warn."""
    _log(mi.LogLevel.Warn, text)


def debug(text: str) -> None:
    """Log a line at level Debug."""
    _log(mi.LogLevel.Debug, text)


def _log(level: mi.LogLevel, text: str) -> None:
    # File names may hold bytes that the locale cannot decode. Python represents them as lone surrogates.
    progress.clear()
    readable = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    mi.Log(level, readable)  # type: ignore[operator]  # Mitsuba's stubs leave it out


def resolve(path: str) -> str:
    """Return `path` as Mitsuba finds it, relative to the folder of the scene file."""
    return str(mi.file_resolver().resolve(path))  # type: ignore[operator]  # Mitsuba's stubs leave it out


class Work(progress.Stage):
    """Work of the plugin `who`, which is part of the progress of a command.

    At level Info it is logged instead: every ``INTERVAL`` seconds while it lasts, and `ended` with the seconds.
    """

    def __init__(self, who: str, title: str, seconds: float = 0.0) -> None:
        self._logs = bool(mi.log_level() <= mi.LogLevel.Info)
        super().__init__(title, seconds=seconds, inner=True, interval=INTERVAL,
                         write=(lambda text: info(f"{who}: {text}")) if self._logs else None)
        self.ended, self._who, self._waited, self._slow = title, who, 0.0, False

    def update(self, done: float, text: str = "") -> None:
        """Show the fraction `done` of the work that was started, after queued kernels have ended."""
        begin = time.monotonic()
        if self.visible and (self._slow or begin - self._waited > 1):
            dr.sync_thread()
            self._waited = time.monotonic()
            self._slow = self._waited - begin > 0.3  # parts that take longer lose nothing by waiting for each
        super().update(done, text)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
                 ) -> None:
        super().__exit__(kind, error, trace)
        if error is None and self._logs and self.ended:
            info(f"{self._who}: {self.ended} ({quantities.duration(self.seconds())})")
