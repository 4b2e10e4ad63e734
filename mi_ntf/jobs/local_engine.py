"""Processes of this machine, one pipe each; of the standard library alone."""

import multiprocessing
import pickle
import signal
from collections import deque
from multiprocessing import connection
from typing import Any

from .options import Workers, gpus
from .worker import Answer, Setup, environment, serve


class Local:
    """Workers that take the next task when they are done with one. A process that failed a task is replaced: its next
    attempt is in another one, whatever state the failure has left."""

    about = ""

    def __init__(self, workers: Workers, work: bytes):
        own = gpus()
        count = workers.workers or 1
        setups = [Setup(workers.share(), own[k % len(own)] if own else None) for k in range(count)]
        self._waiting: deque[tuple[int, Any]] = deque()
        self._slots = [_Slot(setup, work) for setup in setups]

    def submit(self, index: int, task: Any, avoid: str = "") -> None:
        """Put a task behind the others."""
        self._waiting.append((index, task))

    def answer(self) -> Answer:
        """The next one; idle workers are given work before."""
        for slot in self._slots:
            if slot.index is None and self._waiting:
                slot.give(*self._waiting.popleft())
        busy = {slot.pipe: slot for slot in self._slots if slot.index is not None}
        ready: Any = connection.wait(list(busy))[0]
        found = busy[ready].take()
        if found.error:
            busy[ready].end()
        return found

    def close(self) -> None:
        """End all processes at once."""
        for slot in self._slots:
            slot.end()


class _Slot:
    """Place of one worker. `index`: of the task that it has, None while it has none."""

    def __init__(self, setup: Setup, work: bytes):
        self._setup, self._work = setup, work
        self._process: Any = None
        self.pipe: Any = None
        self.index: int | None = None

    def give(self, index: int, task: Any) -> None:
        """Hand over a task, to a new process if need be."""
        if self._process is None or not self._process.is_alive():
            self.end()
            self._start()
        self.index = index
        try:
            self.pipe.send_bytes(pickle.dumps((index, task)))
        except OSError:
            pass  # it has ended since: `take` finds that out

    def take(self) -> Answer:
        """What became of it."""
        index, self.index = self.index, None
        assert index is not None
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode
            how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
            memory = "; had it enough memory?" if code == -signal.SIGKILL else ""
            return Answer(index, error=f"the process that worked on it ended {how}{memory}", lost=True)

    def end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self.pipe.close()
        self._process, self.index = None, None

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # Dr.Jit's threads do not survive a fork
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._setup, self._work), daemon=True)
        with environment(self._setup.variables()):
            self._process.start()
        theirs.close()
