"""Ctrl-C, which Mitsuba, Dr.Jit and imports turn into errors of their own, or lose."""

import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker

from .errors import root

_pressed = threading.Event()
_deferred = False
_signals: socket.socket | None = None
"""Numbers of the signals that have come, as bytes."""


@contextmanager
def noticed() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets within the block, besides raising KeyboardInterrupt as always.

    Errors that it causes leave the block as KeyboardInterrupt. In threads other than the main one, which receive no
    signals, the event stays unset. Blocks may be nested.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is _press:
        yield _pressed
        return
    before = signal.signal(signal.SIGINT, _press)
    # Python calls `_press` when its main thread is back from C++. The system writes to this pipe at once.
    global _signals
    _signals, writing = socket.socketpair()
    _signals.setblocking(False)
    writing.setblocking(False)
    former = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
    try:
        yield _pressed
    except Exception:
        if _pressed.is_set():
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.set_wakeup_fd(former)
        signal.signal(signal.SIGINT, before)
        _pressed.clear()
        _signals.close()
        writing.close()
        _signals = None


@contextmanager
def kept_from_others() -> Iterator[None]:
    """Keep Ctrl-C from processes that start in the block: this process ends them.

    They would print tracebacks, or write the unfinished picture that Mitsuba returns. Ctrl-C in the block is noticed
    at its end.
    """
    resource_tracker.ensure_running()  # otherwise the first process starts one, which lets Ctrl-C through again
    global _deferred
    _deferred = True  # other threads of this process may still receive the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        _deferred = False
    check()


def _press(_number: int, _frame: object) -> None:
    _pressed.set()
    if not _deferred:
        raise KeyboardInterrupt


def caused(error: BaseException) -> bool:
    """Return True if Ctrl-C is the reason of `error`."""
    return _pressed.is_set() or isinstance(root(error), KeyboardInterrupt)


def check() -> None:
    """Raise KeyboardInterrupt if Ctrl-C was pressed, also in threads for which the main one waits."""
    with suppress(BlockingIOError):
        if _signals is not None and signal.SIGINT in _signals.recv(64):
            _pressed.set()
    if _pressed.is_set():
        raise KeyboardInterrupt
