"""Mitsuba's logger and file resolver.

The stock program shows messages from level Info on, Python from level Warn on.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

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
    readable = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    mi.Log(level, readable)  # type: ignore[operator]  # Mitsuba's stubs leave it out


def resolve(path: str) -> str:
    """Return `path` as Mitsuba finds it, relative to the folder of the scene file."""
    return str(mi.file_resolver().resolve(path))  # type: ignore[operator]  # Mitsuba's stubs leave it out


@contextmanager
def timed(action: str) -> Iterator[None]:
    """Log `action` after the block, with the seconds that the block took."""
    begin = time.perf_counter()
    yield
    info(f"{action} ({time.perf_counter() - begin:.2g} s)")


class Progress:
    """Progress of long work called `name`, with an estimate of the remaining time.

    Logs a line every ``INTERVAL`` seconds.
    """

    def __init__(self, name: str) -> None:
        self._name, self._begin = name, time.perf_counter()
        self._last = self._begin

    def __call__(self, done: float) -> None:
        """Report that the fraction `done` of the work has been started; wait for queued kernels before a line."""
        if not 0 < done < 1 or time.perf_counter() - self._last < INTERVAL:
            return
        dr.sync_thread()
        self._last = time.perf_counter()
        remaining = (self._last - self._begin) * (1 / done - 1)
        info(f"{self._name}: {done:.0%}, about {_duration(remaining)} left")


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
