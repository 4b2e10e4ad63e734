"""Tasks are handed to an engine and tried again if they fail, with one line of progress for all of them."""

import pickle
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar, cast

from ..core import interruption, progress
from ..core.errors import MiNtfError
from .options import Workers
from .worker import Answer, describe

ATTEMPTS = 3  # at each task, by different workers if there are several
BARREN = 10  # workers that may end one after the other without an answer; more mean a fault of all
SHOWN = 3  # failures that an error lists

Task = TypeVar("Task")
Result = TypeVar("Result")


class Engine(Protocol):
    """Place where tasks are done."""

    about: str

    def submit(self, index: int, task: object, avoid: str = "") -> None:
        """Queue a task, for another worker than `avoid` if possible."""

    def answer(self) -> Answer:
        """Wait for the outcome of an attempt at one of the tasks."""

    def close(self) -> None:
        """End all work."""


@dataclass(frozen=True)
class Done(Generic[Result]):
    """End of task `index`: the result of the work, or the error of a task that was given up ("" if there is none)."""

    index: int
    value: Result
    error: str = ""


def run(work: Callable[[Task], Result], tasks: Sequence[Task], workers: Workers = Workers(), *,  # noqa: B008
        title: str = "tasks", names: Sequence[str] = (), folder: Path | None = None, done: int = 0) -> list[Result]:
    """Return ``work(task)`` for each of `tasks`, in their order; :func:`each` explains the parameters.

    Raises MiNtfError if tasks fail, after all others are done.
    """
    ends = sorted(each(work, tasks, workers, title=title, names=names, folder=folder, done=done),
                  key=lambda end: end.index)
    failed = [f"{_name(end.index, names)}: {end.error}" for end in ends if end.error]
    if failed:
        more = f"; and {len(failed) - SHOWN} more" if len(failed) > SHOWN else ""
        raise MiNtfError(f"{len(failed)} of {len(tasks)} {title} failed, the others are done: "
                         f"{'; '.join(failed[:SHOWN])}{more}. Run the same command again once that is mended")
    return [end.value for end in ends]


def each(work: Callable[[Task], Result], tasks: Sequence[Task], workers: Workers = Workers(), *,  # noqa: B008
         title: str = "tasks", names: Sequence[str] = (), folder: Path | None = None, done: int = 0
         ) -> Generator[Done[Result], None, None]:
    """Yield the end of every task as it comes, in any order. Closing the generator ends the work.

    Parameters
    ----------
    work : callable
        Function of a module with a small result. It and the tasks are pickled unless this process does the work.
    tasks : sequence
        Arguments of the calls.
    workers : Workers
        This process tries a task once, other workers ``ATTEMPTS`` times.
    title : str
        Plural noun for the tasks, for the line of progress.
    names : sequence of str, optional
        Names of the tasks for messages, their numbers by default.
    folder : Path, optional
        Place for the files of the engine ``submitit``, visible to all machines; they are removed after success.
    done : int
        Number of tasks that earlier runs have done, for the line of progress.

    Raises
    ------
    MiNtfError
        If options do not fit, an engine is not available, or workers end as soon as they begin.
    KeyboardInterrupt
        After Ctrl-C, with the number of tasks that are done.
    """
    workers.check()
    if not tasks:
        return
    if done:
        progress.say(f"goes on: {done} of {done + len(tasks)} {title} are there")
    with progress.Stage(title, done + len(tasks), done=done, then="the same command goes on",
                        warm=workers.workers or 1) as stage:
        if workers.here:
            for index, task in enumerate(tasks):
                yield _do(work, index, task)
                stage.advance()
            return
        engine = _engine(workers, _pickled(work), folder, progress.say)
        try:
            if engine.about:
                progress.say(engine.about)
            for answer in _answers(engine, tasks, names, BARREN + 2 * (workers.workers or 0)):
                yield Done(answer.index, cast(Result, None if answer.error else pickle.loads(answer.value)),
                           answer.error)
                stage.advance()
        finally:
            engine.close()


def _do(work: Callable[[Task], Result], index: int, task: Task) -> Done[Result]:
    try:
        return Done(index, work(task))
    except Exception as error:
        if interruption.caused(error):
            raise KeyboardInterrupt from None
        return Done(index, cast(Result, None), describe(error))


def _answers(engine: Engine, tasks: Sequence[object], names: Sequence[str], barren: int) -> Iterator[Answer]:
    """Yield the last answer to each task, which is tried until it is done or has failed often enough."""
    for index, task in enumerate(tasks):
        engine.submit(index, task)
    attempts, lost, waiting = Counter[int](), 0, len(tasks)
    while waiting:
        answer = engine.answer()
        attempts[answer.index] += 1
        lost = lost + 1 if answer.lost else 0
        if lost >= barren:
            raise MiNtfError(f"{lost} workers ended one after the other without an answer, the last one: "
                             f"{answer.error}; mend that and run again")
        if answer.error and not answer.last and attempts[answer.index] < ATTEMPTS:
            progress.say(f"{_name(answer.index, names)}: {answer.error}; it is tried again", warning=True)
            engine.submit(answer.index, tasks[answer.index], answer.where)
            continue
        waiting -= 1
        yield answer


def _engine(workers: Workers, work: bytes, folder: Path | None, notify: Callable[[str], None]) -> Engine:
    if workers.engine == "local":
        from .local_engine import Local

        return Local(workers, work)
    workers.check_installed()
    if workers.engine == "dask":
        from .dask_engine import Dask

        return Dask(workers, work, notify)
    from .submitit_engine import Submitit

    if folder is None:
        raise MiNtfError("the engine submitit needs a folder for its files; give one that all machines see")
    return Submitit(workers, work, folder)


def _pickled(work: Callable[[Task], Result]) -> bytes:
    """Pickle the function by its name. Raises MiNtfError if a worker could not find it by that."""
    name = f"{getattr(work, '__module__', '?')}.{getattr(work, '__qualname__', work)}"
    try:
        return pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise MiNtfError(f"{name} cannot be sent to workers ({error}); give a function of a module") from None


def _name(index: int, names: Sequence[str]) -> str:
    return names[index] if names else str(index)
