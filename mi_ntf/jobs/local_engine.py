"""Processes of this machine, with one pipe each, from the standard library alone."""

import contextlib
import multiprocessing
import pickle
import signal
from collections import deque
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from typing import cast

from ..core import interruption
from .options import Workers, gpus
from .worker import Answer, Setup, environment, serve


class Local:
    """Worker processes that take the next task when they have finished one.

    A process that failed a task is replaced: the next attempt has a new process, whatever state the failure has left.
    """

    about = ""

    def __init__(self, workers: Workers, work: bytes):
        devices = gpus()
        self._waiting: deque[tuple[int, object]] = deque()
        self._slots = [_Slot(Setup(workers.threads_each(), devices[k % len(devices)] if devices else None), work)
                       for k in range(workers.workers or 1)]

    def submit(self, index: int, task: object, avoid: str = "") -> None:
        """Queue a task."""
        self._waiting.append((index, task))

    def answer(self) -> Answer:
        """Give work to idle workers and return the next answer."""
        for slot in self._slots:
            if slot.index is None and self._waiting:
                slot.give(*self._waiting.popleft())
        busy = {slot.pipe: slot for slot in self._slots if slot.pipe is not None and slot.index is not None}
        slot = busy[cast(connection.Connection, connection.wait(list(busy))[0])]
        answer = slot.take()
        if answer.error:
            slot.end()
        return answer

    def close(self) -> None:
        """End all processes at once."""
        for slot in self._slots:
            slot.end()


class _Slot:
    """Place of one worker; `index` is the number of its task, or None."""

    def __init__(self, setup: Setup, work: bytes):
        self._setup, self._work = setup, work
        self._process: BaseProcess | None = None
        self.pipe: connection.Connection | None = None
        self.index: int | None = None

    def give(self, index: int, task: object) -> None:
        """Hand over a task, to a new process if necessary."""
        if self._process is None or not self._process.is_alive():
            self.end()
            context = multiprocessing.get_context("spawn")  # Dr.Jit's threads do not survive a fork
            self.pipe, theirs = context.Pipe()
            self._process = context.Process(target=serve, args=(theirs, self._setup, self._work), daemon=True)
            with environment(self._setup.variables()), interruption.kept_from_others():
                self._process.start()
            theirs.close()
        assert self.pipe is not None
        self.index = index
        with contextlib.suppress(OSError):  # it has ended since: `take` reports that
            self.pipe.send_bytes(pickle.dumps((index, task)))

    def take(self) -> Answer:
        """Return the answer to the task."""
        index, self.index = self.index, None
        assert index is not None and self.pipe is not None and self._process is not None
        try:
            answer: Answer = self.pipe.recv()
            return answer
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            end = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
            memory = "; had it enough memory?" if code == -signal.SIGKILL else ""
            return Answer(index, error=f"the process that worked on it ended {end}{memory}", lost=True)

    def end(self) -> None:
        """Kill the process."""
        if self._process is not None and self.pipe is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self.pipe.close()
        self._process, self.index = None, None
