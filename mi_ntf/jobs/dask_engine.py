"""The workers of a Dask scheduler, or a cluster of this machine that lives as long as the work."""

import contextlib
import itertools
import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import distributed

from ..core.errors import MiNtfError
from .options import Workers, gpus
from .worker import Answer, Setup, attempt, environment

PATIENCE = 20
"""Seconds to wait for a scheduler to answer."""
AHEAD, LEAST = 4, 32
"""Tasks that the scheduler has for each of its workers, and in all at least: it is slow with very many."""
COUNT = 5.0
"""Seconds between counts of the workers."""
TALK = ("distributed.scheduler", "distributed.client")
"""Loggers that have four lines for every worker that is lost; the one of its restart, of another, stays."""


class Dask:
    """Dask gives the tasks of a worker that is lost to others, four times at most, by itself."""

    def __init__(self, workers: Workers, work: bytes, tell: Callable[[str], None]):
        self._work, self._threads = work, workers.threads
        self._gpus: list[str] = []
        with contextlib.ExitStack() as back:  # what is to be ended or put back
            for logger in map(logging.getLogger, TALK):
                back.callback(logger.setLevel, logger.level)
                logger.setLevel(logging.CRITICAL)
            at = workers.scheduler or self._local(workers, back)
            self._client = _connect(at)
            back.callback(self._client.close)
            self._ended = distributed.as_completed([], loop=self._client.loop, raise_errors=False, with_results=True)
            self._going: dict[Any, int] = {}
            self._waiting: deque[tuple[int, Any, str]] = deque()
            self._room, self._counted = LEAST, -COUNT
            self._number = itertools.count()
            self.about = f"Dask's dashboard: {self._client.dashboard_link}"
            if not self._workers():
                tell(f"no worker has joined {at} yet; start some with: dask worker {at}")
            self._back = back.pop_all()

    def _local(self, workers: Workers, back: contextlib.ExitStack) -> Any:
        """A cluster of this machine."""
        self._threads, self._gpus = workers.share(), gpus()
        variables = Setup(self._threads).variables()
        back.enter_context(environment(variables))  # Dask sets them in this process, too, and leaves them
        # No limit of memory: the share that Dask would kill at is no measure of what a picture needs for a moment.
        try:
            with _ctrl_c_is_ours():
                cluster = distributed.LocalCluster(
                    n_workers=workers.workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0",
                    memory_limit=0, env=variables)
        except RuntimeError as error:
            raise MiNtfError(f"the Dask cluster of this machine did not start ({error}); a script that starts one must "
                             "be a file that begins its work below `if __name__ == '__main__':`") from None
        back.callback(cluster.close)
        return cluster

    def submit(self, index: int, task: Any, avoid: str = "") -> None:
        """Put a task behind the others."""
        self._waiting.append((index, task, avoid))

    def answer(self) -> Answer:
        """The next one; the scheduler is given work before."""
        self._fill()
        future, found = next(self._ended)
        index = self._going.pop(future)
        if isinstance(found, Answer):
            return found
        if self._client.status != "running":
            raise MiNtfError(f"the Dask scheduler is gone (connection {self._client.status}); start it and run the "
                             "same command again")
        error = future.exception() if future.status == "error" else None
        if isinstance(error, distributed.KilledWorker):
            return Answer(index, error=f"every worker that took it ended, {error.last_worker.address} the last; had "
                          "they enough memory?", last=True)
        return Answer(index, error=f"Dask gave it up ({error or future.status})", lost=True)

    def _fill(self) -> None:
        if self._waiting and time.monotonic() - self._counted > COUNT:
            self._room, self._counted = max(LEAST, AHEAD * len(self._workers())), time.monotonic()
        while self._waiting and len(self._going) < self._room:
            index, task, avoid = self._waiting.popleft()
            others = [name for name in self._workers() if name != avoid] if avoid else []
            future = self._client.submit(
                try_task, self._work, index, task, self._threads, self._gpus, pure=False,
                key=f"mi-ntf-{index}-{next(self._number)}", workers=others or None, allow_other_workers=bool(others))
            self._going[future] = index
            self._ended.add(future)

    def _workers(self) -> list[str]:
        """Addresses."""
        return list(self._client.scheduler_info(n_workers=-1)["workers"])

    def close(self) -> None:
        """Cancel what is not done; a cluster of this machine ends."""
        self._client.cancel(list(self._going), force=True)
        self._going.clear()
        self._back.close()


def try_task(work: bytes, index: int, task: Any, threads: int | None, devices: list[str]) -> Answer:
    """In a worker: one attempt. `threads`: those of the worker unless given; `devices`: GPUs that the cluster's
    workers, which have numbers for names, divide among themselves."""
    worker: Any = distributed.get_worker()
    gpu = devices[int(worker.name) % len(devices)] if devices else None
    return attempt(Setup(threads or worker.state.nthreads, gpu), work, index, task, worker.address)


@contextlib.contextmanager
def _ctrl_c_is_ours() -> Iterator[None]:
    """Within, processes are started that do not hear Ctrl-C: this one ends them, and they would all print frames."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _connect(address: Any) -> distributed.Client:
    try:
        return distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise MiNtfError(f"no Dask scheduler answers at {address} ({error}); start one with: dask scheduler") from None
