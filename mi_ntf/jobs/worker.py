"""Code that runs in a worker: its set-up, once, and tasks one after the other.

Nothing heavy is imported before the set-up.
"""

import importlib.util
import os
import pickle
import platform
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from ..core import errors
from ..core.variants import enough_threads

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Read by PyTorch and NumPy when they are loaded."""


@dataclass(frozen=True)
class Setup:
    """Set-up of a worker. `threads`: None leaves them as they are; `gpu`: CUDA_VISIBLE_DEVICES, None leaves it."""

    threads: int | None = None
    gpu: str | None = None

    def variables(self) -> dict[str, str]:
        """Environment variables."""
        found = {} if self.threads is None else dict.fromkeys(THREAD_VARIABLES, str(self.threads))
        return found | ({} if self.gpu is None else {"CUDA_VISIBLE_DEVICES": self.gpu})


@dataclass(frozen=True)
class Answer:
    """Outcome of one attempt at task `index`: `value`, pickled, or `error`, a sentence that is not empty. `where`:
    who tried; `lost`: the worker ended; `last`: another attempt is of no use."""

    index: int
    value: bytes = b""
    error: str = ""
    where: str = ""
    seconds: float = 0.0
    lost: bool = False
    last: bool = False


_one_at_a_time = threading.Lock()  # a Dask worker may have several threads, Mitsuba has one variant
_prepared: set[Setup] = set()
_loaded: dict[bytes, Callable] = {}


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


def attempt(setup: Setup, work: bytes, index: int, task: Any, where: str = "") -> Answer:
    """Try one task of the pickled function `work`, which is loaded after the set-up."""
    where = where or f"{platform.node()}:{os.getpid()}"
    with _one_at_a_time:
        start = time.perf_counter()
        try:
            prepare(setup)
            if work not in _loaded:
                _loaded[work] = pickle.loads(work)
            value = pickle.dumps(_loaded[work](task))
        except Exception as error:
            return Answer(index, error=told(error), where=where, seconds=time.perf_counter() - start)
        return Answer(index, value, where=where, seconds=time.perf_counter() - start)


def told(error: BaseException) -> str:
    """A sentence, never empty; with frames where the user wants them."""
    text = errors.sentence(error) or type(error).__name__
    return f"{text}\n{''.join(traceback.format_exception(error))}" if errors.debug() else text


@contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """Within, processes are started with `variables` besides."""
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


def serve(pipe: Any, setup: Setup, work: bytes) -> None:
    """A worker of the engine ``local``: (index, task) come by `pipe`, answers go, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one, which ends it
    while True:
        try:
            index, task = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return
        pipe.send(attempt(setup, work, index, task))


def do_share(setup: Setup, work: bytes, share: list[tuple[int, Any]], path: str) -> None:
    """A job of the engine ``submitit``: the (index, task) of `share` one after the other. Each answer is appended to
    the file `path`, a length of 8 bytes before it: what is done when the job is lost is not lost with it."""
    with open(path, "ab") as stream:
        for index, task in share:
            answer = pickle.dumps(attempt(setup, work, index, task))
            stream.write(len(answer).to_bytes(8, "little") + answer)
            stream.flush()
            os.fsync(stream.fileno())


def read_answers(path: str, offset: int) -> tuple[list[Answer], int]:
    """Whole answers of a file of :func:`do_share` from `offset` on, and where the next begins."""
    try:
        with open(path, "rb") as stream:
            stream.seek(offset)
            content = stream.read()
    except FileNotFoundError:
        return [], offset
    found, at = [], 0
    while len(content) >= at + 8 and len(content) >= (end := at + 8 + int.from_bytes(content[at:at + 8], "little")):
        found.append(pickle.loads(content[at + 8:end]))
        at = end
    return found, offset + at
