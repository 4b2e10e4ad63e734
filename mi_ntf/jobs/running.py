"""Tasks are handed to an engine and tried again if they fail, with one progress bar for all of them."""

import pickle
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

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
        title: str = "tasks", names: Sequence[str] = (), folder: Path | None = None, quiet: bool = False
        ) -> list[Result]:
    """Return ``work(task)`` for each of `tasks`, in their order; :func:`each` explains the parameters.

    Raises MiNtfError if tasks fail, after all others are done.
    """
    ends = sorted(each(work, tasks, workers, title=title, names=names, folder=folder, quiet=quiet),
                  key=lambda done: done.index)
    failed = [f"{_name(done.index, names)}: {done.error}" for done in ends if done.error]
    if failed:
        more = f"; and {len(failed) - SHOWN} more" if len(failed) > SHOWN else ""
        raise MiNtfError(f"{len(failed)} of {len(tasks)} {title} failed, the others are done: "
                         f"{'; '.join(failed[:SHOWN])}{more}. Run the same command again once that is mended")
    return [done.value for done in ends]


def each(work: Callable[[Task], Result], tasks: Sequence[Task], workers: Workers = Workers(), *,  # noqa: B008
         title: str = "tasks", names: Sequence[str] = (), folder: Path | None = None, quiet: bool = False
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
        Plural noun for the tasks, for the progress bar.
    names : sequence of str, optional
        Names of the tasks for messages, their numbers by default.
    folder : Path, optional
        Place for the files of the engine ``submitit``, visible to all machines; they are removed after success.
    quiet : bool
        Shows no bar.

    Raises
    ------
    MiNtfError
        If options do not fit, an engine is not available, or workers end as soon as they begin.
    """
    workers.check()
    if not tasks:
        return
    with _bar(title, len(tasks), quiet) as (notify, advance):
        if workers.here:
            for index, task in enumerate(tasks):
                yield _do(work, index, task)
                advance()
            return
        engine = _engine(workers, _pickled(work), folder, notify)
        try:
            if engine.about:
                notify(engine.about)
            for answer in _answers(engine, tasks, names, BARREN + 2 * (workers.workers or 0), notify):
                yield Done(answer.index, cast(Result, None if answer.error else pickle.loads(answer.value)),
                           answer.error)
                advance()
        finally:
            engine.close()


def _do(work: Callable[[Task], Result], index: int, task: Task) -> Done[Result]:
    try:
        return Done(index, work(task))
    except Exception as error:
        return Done(index, cast(Result, None), describe(error))


def _answers(engine: Engine, tasks: Sequence[object], names: Sequence[str], barren: int, notify: Callable[[str], None]
             ) -> Iterator[Answer]:
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
            notify(f"{_name(answer.index, names)}: {answer.error}; it is tried again")
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


@contextmanager
def _bar(title: str, total: int, quiet: bool) -> Iterator[tuple[Callable[[str], None], Callable[[], None]]]:
    """Yield functions that print a line above the bar, and that count one task more."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left"), TimeRemainingColumn())
    progress = Progress(*columns, console=console, transient=True)
    with nullcontext() if quiet else progress:
        bar = progress.add_task(title, total=total)

        def notify(text: str) -> None:
            if quiet:
                print(text, file=sys.stderr)
            else:
                console.print(text, markup=False, soft_wrap=True)

        yield notify, lambda: progress.advance(bar)


def _name(index: int, names: Sequence[str]) -> str:
    return names[index] if names else str(index)
