"""Code that runs in a worker: its set-up, once, and tasks one after the other.

Nothing heavy is imported before the set-up.
"""

import importlib.util
import os
import pickle
import platform
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

from ..core import errors
from ..core.variants import enough_threads

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")  # PyTorch and NumPy read them once


@dataclass(frozen=True)
class Setup:
    """Set-up of a worker; None leaves a setting as it is."""

    threads: int | None = None
    gpu: str | None = None  # value of CUDA_VISIBLE_DEVICES

    def variables(self) -> dict[str, str]:
        """Return the environment variables."""
        threads = {} if self.threads is None else dict.fromkeys(THREAD_VARIABLES, str(self.threads))
        return threads | ({} if self.gpu is None else {"CUDA_VISIBLE_DEVICES": self.gpu})


@dataclass(frozen=True)
class Answer:
    """Outcome of one attempt at task `index`."""

    index: int
    value: bytes = b""  # pickled result
    error: str = ""  # a sentence if the attempt failed
    where: str = ""  # name of the worker
    lost: bool = False  # the worker ended
    last: bool = False  # another attempt is of no use


_one_at_a_time = threading.Lock()  # a Dask worker may have several threads, Mitsuba has one variant
_prepared: set[Setup] = set()
_loaded: dict[bytes, Callable[[object], object]] = {}


def prepare(setup: Setup) -> None:
    """Set threads and GPU of this process, once."""
    if setup in _prepared:
        return
    os.environ.update(setup.variables())
    if setup.threads is not None and importlib.util.find_spec("drjit"):
        import drjit

        drjit.set_thread_count(setup.threads)
        enough_threads(drjit)
    _prepared.add(setup)


def attempt(setup: Setup, work: bytes, index: int, task: object, where: str = "") -> Answer:
    """Try one task of the pickled function `work`, which is loaded after the set-up."""
    where = where or f"{platform.node()}:{os.getpid()}"
    with _one_at_a_time:
        try:
            prepare(setup)
            if work not in _loaded:
                _loaded[work] = pickle.loads(work)
            return Answer(index, pickle.dumps(_loaded[work](task)), where=where)
        except Exception as error:
            return Answer(index, error=describe(error), where=where)


def describe(error: BaseException) -> str:
    """Return a sentence about `error`, with a traceback if the user wants one. It is never empty."""
    text = errors.sentence(error) or type(error).__name__
    return f"{text}\n{''.join(traceback.format_exception(error))}" if errors.debug() else text


@contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """Add `variables` to the environment of the processes that are started in the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def serve(pipe: Connection, setup: Setup, work: bytes) -> None:
    """Be a worker of the engine ``local``: answer each (index, task) that comes through `pipe` until it is closed."""
    while True:
        try:
            index, task = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return
        pipe.send(attempt(setup, work, index, task))


def do_tasks(setup: Setup, work: bytes, tasks: list[tuple[int, object]], path: str) -> None:
    """Be a job of the engine ``submitit``: do each (index, task) and append its answer to the file `path`.

    A length of 8 bytes precedes each answer. Answers that are written stay if the job is lost.
    """
    with open(path, "ab") as stream:
        for index, task in tasks:
            answer = pickle.dumps(attempt(setup, work, index, task))
            stream.write(len(answer).to_bytes(8, "little") + answer)
            stream.flush()
            os.fsync(stream.fileno())


def read_answers(path: str, offset: int) -> tuple[list[Answer], int]:
    """Return the whole answers in a file of :func:`do_tasks` from `offset` on, and the offset of the next one."""
    try:
        with open(path, "rb") as stream:
            stream.seek(offset)
            content = stream.read()
    except FileNotFoundError:
        return [], offset
    answers, start = [], 0
    while (len(content) >= start + 8
           and len(content) >= (end := start + 8 + int.from_bytes(content[start:start + 8], "little"))):
        answers.append(pickle.loads(content[start + 8:end]))
        start = end
    return answers, offset + start
