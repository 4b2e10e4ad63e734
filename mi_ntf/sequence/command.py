"""The work of ``mi-ntf sequence``: list the frames, check which exist, render the others."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ..core import files, progress
from ..core.errors import MiNtfError
from ..core.quantities import duration
from ..jobs import Workers, each
from ..render.scene.environment_option import Environment
from . import image_file, parameters, timeline
from .film import Film
from .timeline import Frame, Timeline
from .work import Task, key, render


@dataclass
class Check:
    """Number of `images`, of those that are `done`, and a sentence for each other one by the kind of its fault."""

    images: int
    done: int = 0
    missing: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    other: list[str] = field(default_factory=list)

    @property
    def faults(self) -> list[str]:
        """Sentences of all kinds."""
        return self.missing + self.broken + self.other


@dataclass(frozen=True)
class Summary:
    """Result of :func:`run`, with times in seconds."""

    folder: str
    images: int
    existing: int
    rendered: int
    seconds: float
    first: float | None
    each: float | None  # median of all but the first
    each_of: list[float]
    film: str | None = None
    toned: str | None = None  # description of the film's tones

    def as_data(self) -> dict[str, object]:
        """Return the report of `mi-ntf sequence --json`."""
        data = asdict(self)
        return data | {"kept": data.pop("existing")}


def shard(text: str) -> tuple[int, int]:
    """Return ``(i, n)`` of "i/n", the i-th of n shards, counted from 1. Raises ValueError with what is allowed."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    i, n = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= i <= n:
        raise ValueError(f"--shard is {text}, expected i/n with i from 1 to n: 1/4, 2/4, 3/4 and 4/4 are the whole")
    return i, n


def frames_of(timeline_file: Path | None, table: Path | None, fixed: dict[str, str]) -> Timeline:
    """Return the frames of a timeline or a table of parameters. With neither, the scene itself is one frame."""
    if timeline_file is not None:
        return timeline.read(timeline_file, fixed)
    return parameters.read(table, fixed) if table is not None else Timeline([Frame(0, dict(fixed))])


def tasks_of(scene: Path, folder: Path, frames: list[Frame], variant: str = "",
             environment: Environment | None = None) -> list[Task]:
    """Return one task for each frame."""
    if environment and environment.file:
        environment = replace(environment, file=environment.file.absolute())  # workers may run in another folder
    return [Task(str(scene), str(folder), frame, len(frames), variant, environment) for frame in frames]


def check(tasks: list[Task]) -> Check:
    """Read all files that the tasks would write."""
    result = Check(len(tasks))
    for _, fault in _faults(tasks):
        if fault is None:
            result.done += 1
        else:
            getattr(result, fault.kind).append(fault.text)
    return result


def run(tasks: list[Task], work: Callable[[Task], float] = render, film: Film | None = None,
        workers: Workers = Workers()) -> Summary:  # noqa: B008
    """Render the frames that are not there yet, and at the end their `film`.

    `work` makes one frame and returns its seconds. Broken frames and frames of other parameters are named on standard
    error and rendered again. Raises MiNtfError if frames fail: in this process at once, with workers after the others.
    """
    begin = time.perf_counter()
    if film:
        film.check()
    if tasks:
        files.make_folder(Path(tasks[0].folder))
    todo = []
    for task, fault in _faults(tasks):
        if fault is not None:
            todo.append(task)
            if fault.kind != "missing":
                progress.say(f"mi-ntf: made anew: {fault.text}", warning=True)
    seconds = _rendered(todo, len(tasks) - len(todo), work, workers)
    if film:
        with progress.Stage(f"encoding {film.path}", then="all frames are there, and the same command makes the film"):
            film.write(task.path for task in tasks)
    return Summary(tasks[0].folder if tasks else "", len(tasks), len(tasks) - len(todo), len(todo),
                   time.perf_counter() - begin, seconds[0] if seconds else None,
                   float(np.median(seconds[1:])) if seconds[1:] else None, seconds,
                   str(film.path) if film else None, film.note if film else None)


def _rendered(tasks: list[Task], existing: int, work: Callable[[Task], float], workers: Workers) -> list[float]:
    """Render the frames of `tasks` and return the seconds of each, in the order in which they ended.

    `existing` is the number of frames that are there already.
    """
    if not tasks:
        return []
    folder = Path(tasks[0].folder).absolute()
    names = [task.path.name for task in tasks]
    if not workers.here:
        tasks = [replace(task, scene=str(Path(task.scene).absolute()), folder=str(folder)) for task in tasks]
    seconds: list[float] = []
    errors: list[str] = []
    with closing(each(work, tasks, workers, title="frames", names=names, folder=folder, done=existing)) as results:
        for result in results:
            if not result.error:
                seconds.append(result.value)
            elif workers.here:
                raise MiNtfError(result.error)
            else:
                errors.append(result.error)
    if errors:
        raise MiNtfError(f"{len(errors)} of {len(tasks)} images failed, the others are done: {'; '.join(errors[:3])}. "
                         "Run the same command again once that is mended")
    return seconds


def print_check(result: Check) -> None:
    """Print the number of intact images."""
    print(f"{result.done} of {result.images} images are there")


def print_summary(summary: Summary) -> None:
    """Print the result of :func:`run`."""
    existing = f", {summary.existing} of them from an earlier run" if summary.existing else ""
    print(f"frames: {summary.folder} ({summary.images}{existing})")
    if summary.first is not None:
        others = "" if summary.each is None else f"; each other one {duration(summary.each)} (median)"
        print(f"time: {duration(summary.seconds)}; the first frame {duration(summary.first)}{others}")
    if summary.film is not None:
        print(f"film: {summary.film} ({summary.toned})")
    elif summary.images > 1:
        print("next: the same command with --film FILM.mp4 makes a film of them")


def _faults(tasks: list[Task]) -> Iterator[tuple[Task, image_file.Fault | None]]:
    """Yield each task with the fault of its file, None if the file is intact."""
    with progress.Stage("frames looked for", len(tasks), then="nothing was changed") as stage:
        for task in tasks:
            yield task, _fault(task)
            stage.advance()


def _fault(task: Task) -> image_file.Fault | None:
    return image_file.fault(task.path, key(task))
