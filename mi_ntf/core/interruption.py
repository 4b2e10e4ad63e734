"""Ctrl-C while Mitsuba renders, which turns KeyboardInterrupt into a RuntimeError of its own."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def noticed() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets within the block, besides raising KeyboardInterrupt as always.

    In threads other than the main one, which receive no signals, the event stays unset.
    """
    pressed = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield pressed
        return

    def press(_number: int, _frame: object) -> None:
        pressed.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, press)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)
