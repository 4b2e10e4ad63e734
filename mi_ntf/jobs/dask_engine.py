"""Workers of a Dask scheduler, or of a cluster of this machine that lives as long as the work."""

import contextlib
import itertools
import logging
import time
from collections import deque
from collections.abc import Callable

import distributed

from ..core import interruption
from ..core.errors import MiNtfError
from .options import Workers, gpus
from .worker import Answer, Setup, attempt, environment

PATIENCE = 20  # seconds to wait for a scheduler to answer
AHEAD, LEAST = 4, 32  # tasks at the scheduler for each worker, and in all at least: it is slow with very many
COUNT = 5.0  # seconds between counts of the workers
LOGGERS = ("distributed.scheduler", "distributed.client")  # they print four lines for every worker that is lost


class Dask:
    """Dask itself gives the tasks of a worker that is lost to others, four times at most."""

    def __init__(self, workers: Workers, work: bytes, notify: Callable[[str], None]):
        self._work, self._threads = work, workers.threads
        self._gpus: list[str] = []
        with contextlib.ExitStack() as stack:  # everything that `close` ends or restores
            for logger in map(logging.getLogger, LOGGERS):
                stack.callback(logger.setLevel, logger.level)
                logger.setLevel(logging.CRITICAL)
            address = workers.scheduler or self._local(workers, stack)
            self._client = _connect(address)
            stack.callback(self._client.close)
            self._ended = distributed.as_completed([], loop=self._client.loop, raise_errors=False, with_results=True)
            self._running: dict[distributed.Future[Answer], int] = {}
            self._waiting: deque[tuple[int, object, str]] = deque()
            self._room, self._counted = LEAST, -COUNT
            self._number = itertools.count()
            self.about = f"Dask's dashboard: {self._client.dashboard_link}"
            if not self._workers():
                notify(f"no worker has joined {address} yet; start some with: dask worker {address}")
            self._stack = stack.pop_all()

    def _local(self, workers: Workers, stack: contextlib.ExitStack) -> distributed.LocalCluster:
        self._threads, self._gpus = workers.threads_each(), gpus()
        variables = Setup(self._threads).variables()
        stack.enter_context(environment(variables))  # Dask sets them in this process, too, and never restores them
        # No limit of memory: Dask's limit is no measure of the memory that a picture needs for a moment.
        try:
            with interruption.kept_from_others():
                cluster = distributed.LocalCluster(
                    n_workers=workers.workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0",
                    memory_limit=0, env=variables)
        except RuntimeError as error:
            raise MiNtfError(f"the Dask cluster of this machine did not start ({error}); a script that starts one must "
                             "be a file that begins its work below `if __name__ == '__main__':`") from None
        stack.callback(cluster.close)
        return cluster

    def submit(self, index: int, task: object, avoid: str = "") -> None:
        """Queue a task."""
        self._waiting.append((index, task, avoid))

    def answer(self) -> Answer:
        """Give queued tasks to the scheduler and return the next answer."""
        self._fill()
        future, result = next(self._ended)
        index = self._running.pop(future)
        if isinstance(result, Answer):
            return result
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
        while self._waiting and len(self._running) < self._room:
            index, task, avoid = self._waiting.popleft()
            allowed = [name for name in self._workers() if name != avoid] if avoid else []
            future = self._client.submit(
                try_task, self._work, index, task, self._threads, self._gpus, pure=False,
                key=f"mi-ntf-{index}-{next(self._number)}", workers=allowed or None, allow_other_workers=bool(allowed))
            self._running[future] = index
            self._ended.add(future)

    def _workers(self) -> list[str]:
        return list(self._client.scheduler_info(n_workers=-1)["workers"])

    def close(self) -> None:
        """Cancel unfinished tasks; a cluster of this machine ends."""
        self._client.cancel(list(self._running), force=True)
        self._running.clear()
        self._stack.close()


def try_task(work: bytes, index: int, task: object, threads: int | None, devices: list[str]) -> Answer:
    """Make one attempt in a worker, which has its own number of threads if `threads` is None.

    The workers of a local cluster, whose names are numbers, divide the GPUs `devices` among themselves.
    """
    worker = distributed.get_worker()
    gpu = devices[int(str(worker.name)) % len(devices)] if devices else None
    return attempt(Setup(threads or worker.state.nthreads, gpu), work, index, task, worker.address)


def _connect(address: str | distributed.LocalCluster) -> distributed.Client:
    try:
        return distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise MiNtfError(f"no Dask scheduler answers at {address} ({error}); start one with: dask scheduler") from None
