"""Messages of a render through Mitsuba's logger, at level Info, which the stock program shows and Python does not."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

PATIENCE = 3.0
"""Seconds between two lines of progress; shorter work shows none."""


def info(text: str) -> None:
    """Log a line."""
    # Names of files may hold bytes that the locale cannot read; Python keeps them as lone surrogates.
    readable = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    mi.Log(mi.LogLevel.Info, readable)  # type: ignore[operator]  # an object in the stub


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Log `what` was done in the block, and the seconds that it took."""
    begin = time.perf_counter()
    yield
    info(f"{what} ({time.perf_counter() - begin:.2g} s)")


class Progress:
    """Progress of long work called `what`, with the time left: a line every ``PATIENCE`` seconds."""

    def __init__(self, what: str):
        self._what, self._begin = what, time.perf_counter()
        self._last = self._begin

    def __call__(self, done: float) -> None:
        """The fraction `done` of the work has been started; what is still queued is waited for before a line."""
        if not 0 < done < 1 or time.perf_counter() - self._last < PATIENCE:
            return
        dr.sync_thread()
        self._last = time.perf_counter()
        left = (self._last - self._begin) * (1 / done - 1)
        info(f"{self._what}: {done:.0%}, about {_duration(left)} left")


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min" if seconds < 6000 else \
        f"{seconds / 3600:.1f} h"
