"""Tasks handed to an engine, tried again where they fail, with one bar over all of them."""

import pickle
import sys
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..core.errors import MiNtfError
from .options import Workers, load
from .worker import Answer, told

ATTEMPTS = 3
"""At a task, each by another worker where there is one."""
BARREN = 10
"""Workers that end one after the other, none of them with an answer, after which there is something wrong with all."""
SHOWN = 3
"""Failures that an error tells."""


class Engine(Protocol):
    """`submit` hands over a task, where it may go elsewhere than to the worker `avoid`; `answer` waits for what becomes
    of one of them; `close` ends all work."""

    about: str

    def submit(self, index: int, task: Any, avoid: str = "") -> None: ...

    def answer(self) -> Answer: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Done:
    """Task `index` is done, with what `work` returned, or was given up: `error` says why, "" where it is done."""

    index: int
    value: Any = None
    error: str = ""


def run(work: Callable[[Any], Any], tasks: Sequence[Any], workers: Workers = Workers(), *,  # noqa: B008
        title: str = "tasks", names: Sequence[str] = (), folder: Path | None = None, quiet: bool = False) -> list[Any]:
    """What ``work(task)`` returns for each of `tasks`, in their order; see :func:`each`.

    Raises MiNtfError where tasks fail, after the others are done.
    """
    found: list[Any] = [None] * len(tasks)
    failed: dict[int, str] = {}
    for done in each(work, tasks, workers, title=title, names=names, folder=folder, quiet=quiet):
        if done.error:
            failed[done.index] = done.error
        found[done.index] = done.value
    if failed:
        raise MiNtfError(_failures(failed, len(tasks), title, names))
    return found


def each(work: Callable[[Any], Any], tasks: Sequence[Any], workers: Workers = Workers(), *,  # noqa: B008
         title: str = "tasks", names: Sequence[str] = (), needs: Sequence[Collection[int]] = (),
         folder: Path | None = None, quiet: bool = False) -> Generator[Done, None, None]:
    """Every task's end as it comes, in any order. To close the iterator ends the work.

    Args:
        work: function of a module, task → something small; both are pickled unless all is done in this process.
        tasks: what it is called with.
        workers: who does them. In this process a task is tried once, by others `ATTEMPTS` times.
        title: what tasks are, in the plural, for the bar.
        names: of the tasks, for messages; their numbers unless given.
        needs: for each task the numbers of those before it in the list that it waits for. Where one of them fails, the
            task is not begun and fails, too.
        folder: where the engine ``submitit`` keeps its files, seen by all machines; removed where all went well.
        quiet: no bar.

    Raises MiNtfError for options that do not fit, an engine that is not installed or not there, and workers that end
    as soon as they begin.
    """
    workers.check()
    if not tasks:
        return
    with _bar(title, len(tasks), quiet) as (tell, advance):
        order = _Order(len(tasks), names, needs)
        if workers.here:
            for done in _here(work, tasks, order):
                yield done
                advance()
            return
        engine = _engine(workers, _pickled(work), folder, tell)
        try:
            if engine.about:
                tell(engine.about)
            for done in _tried(engine, tasks, names, order, BARREN + 2 * (workers.workers or 0), tell):
                yield done
                advance()
        finally:
            engine.close()


class _Order:
    """Which tasks may begin, and which never will, after others have ended."""

    def __init__(self, count: int, names: Sequence[str], needs: Sequence[Collection[int]]):
        self._names, self._open = names, {k: set(needs[k]) if needs else set() for k in range(count)}

    def ready(self) -> list[int]:
        """Tasks that wait for nothing, each told once."""
        found = [k for k, open_ in self._open.items() if not open_]
        for k in found:
            del self._open[k]
        return found

    def ended(self, done: Done) -> list[Done]:
        """Those that can no longer be done now that `done` is."""
        waiting = [k for k, open_ in self._open.items() if done.index in open_]
        if not done.error:
            for k in waiting:
                self._open[k].discard(done.index)
            return []
        failed: list[Done] = []
        for k in waiting:
            if self._open.pop(k, None) is not None:
                lost = Done(k, error=f"{_name(done.index, self._names)} failed, which it needs")
                failed += [lost, *self.ended(lost)]
        return failed


def _here(work: Callable[[Any], Any], tasks: Sequence[Any], order: _Order) -> Iterator[Done]:
    """The ends of all tasks, done in this process."""
    while ready := order.ready():
        for k in ready:
            try:
                done = Done(k, work(tasks[k]))
            except Exception as error:
                done = Done(k, error=told(error))
            yield done
            yield from order.ended(done)


def _tried(engine: Engine, tasks: Sequence[Any], names: Sequence[str], order: _Order, barren: int,
           tell: Callable[[str], None]) -> Iterator[Done]:
    """The ends of all tasks, each tried until it is done or has failed often enough."""
    tries, lost, going = Counter[int](), 0, 0
    while True:
        for k in order.ready():
            engine.submit(k, tasks[k])
            going += 1
        if not going:
            return
        answer = engine.answer()
        k = answer.index
        tries[k] += 1
        lost = lost + 1 if answer.lost else 0
        if lost >= barren:
            raise MiNtfError(f"{lost} workers ended one after the other without an answer, the last one: "
                             f"{answer.error}; mend that and run again")
        if answer.error and not answer.last and tries[k] < ATTEMPTS:
            tell(f"{_name(k, names)}: {answer.error}; it is tried again")
            engine.submit(k, tasks[k], answer.where)
            continue
        going -= 1
        done = Done(k, error=answer.error) if answer.error else Done(k, pickle.loads(answer.value))
        yield done
        yield from order.ended(done)


def _engine(workers: Workers, work: bytes, folder: Path | None, tell: Callable[[str], None]) -> Engine:
    if workers.engine == "dask":
        load("dask")
        from .dask_engine import Dask

        return Dask(workers, work, tell)
    if workers.engine == "submitit":
        load("submitit")
        from .submitit_engine import Submitit

        if folder is None:
            raise MiNtfError("the engine submitit needs a folder for its files; give one that all machines see")
        return Submitit(workers, work, folder)
    from .local_engine import Local

    return Local(workers, work)


def _pickled(work: Callable) -> bytes:
    """The function by its name. Raises MiNtfError where a worker could not find it by that."""
    name = f"{getattr(work, '__module__', '?')}.{getattr(work, '__qualname__', work)}"
    try:
        return pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise MiNtfError(f"{name} cannot be sent to workers ({error}); give a function of a module") from None


@contextmanager
def _bar(title: str, total: int, quiet: bool) -> Iterator[tuple[Callable[[str], None], Callable[[], None]]]:
    """Functions that print a line above the bar, and that count one task more."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left"), TimeRemainingColumn())
    progress = Progress(*columns, console=console, transient=True)
    with nullcontext() if quiet else progress:
        bar = progress.add_task(title, total=total)

        def tell(text: str) -> None:
            if quiet:
                print(text, file=sys.stderr)
            else:
                console.print(text, markup=False, soft_wrap=True)

        yield tell, lambda: progress.advance(bar)


def _name(index: int, names: Sequence[str]) -> str:
    return names[index] if names else str(index)


def _failures(failed: dict[int, str], total: int, title: str, names: Sequence[str]) -> str:
    first = [f"{_name(k, names)}: {failed[k]}" for k in sorted(failed)[:SHOWN]]
    more = f"; and {len(failed) - SHOWN} more" if len(failed) > SHOWN else ""
    return (f"{len(failed)} of {total} {title} failed, the others are done: {'; '.join(first)}{more}. Run the same "
            "command again once that is mended")
