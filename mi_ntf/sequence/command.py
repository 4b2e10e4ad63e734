"""``mi-ntf sequence``: which images are to be made, which of them are there, and making the others."""

import re
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core import files
from ..core.errors import MiNtfError
from ..jobs import Workers, each
from ..render.scene.environment_option import Environment
from . import film as films
from . import image_file, parameters, timeline
from .timeline import Frame, Timeline
from .work import Task, key, render


def shard(text: str) -> tuple[int, int]:
    """``(i, n)`` of "i/n", the i-th of n shards, counted from 1. Raises ValueError that says what is legal."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    i, n = (int(v) for v in found.groups()) if found else (0, 0)
    if not 1 <= i <= n:
        raise ValueError(f"--shard is {text}, expected i/n with i from 1 to n: 1/4, 2/4, 3/4 and 4/4 are the whole")
    return i, n


def frames_of(line: Path | None, table: Path | None, fixed: dict[str, str]) -> Timeline:
    """Those of a timeline, of a table of parameters, or the scene as it is, one frame."""
    if line is not None:
        return timeline.read(line, fixed)
    return parameters.read(table, fixed) if table is not None else Timeline([Frame(0, dict(fixed))])


def tasks_of(scene: Path, folder: Path, frames: list[Frame], parts: int = 1, variant: str = "",
             environment: Environment | None = None) -> list[Task]:
    """One for each image of the sequence, frame by frame."""
    return [Task(str(scene), str(folder), frame, len(frames), part, parts, variant, environment)
            for frame in frames for part in range(parts)]


def check(tasks: list[Task]) -> dict[str, Any]:
    """Read all that the tasks would write: ``frames``, how many are ``done``, and below ``missing``, ``broken`` and
    ``other`` a sentence for each that is not."""
    found: dict[str, Any] = {"images": len(tasks), "done": 0}
    found |= {kind: [] for kind in (image_file.MISSING, image_file.BROKEN, image_file.OTHER)}
    for task in tasks:
        wrong = _fault(task)
        if wrong is None:
            found["done"] += 1
        else:
            found[wrong[0]].append(wrong[1])
    return found


def faults(found: dict[str, Any]) -> list[str]:
    """All sentences of what :func:`check` found."""
    return [text for kind in (image_file.MISSING, image_file.BROKEN, image_file.OTHER) for text in found[kind]]


def run(tasks: list[Task], work: Callable[[Task], dict[str, Any]] = render, quiet: bool = False,
        film: tuple[Path, float, float] | None = None, workers: Workers = Workers()) -> dict[str, Any]:  # noqa: B008
    """Make what is not there yet by `work`, one image after the other or by several `workers`, and at the end the
    `film`: file, frames a second, stops of exposure (:mod:`mi_ntf.sequence.film`). Returns ``images``, ``kept`` (there
    before), ``rendered``, ``seconds`` of all, ``first`` and ``each``, the median of the others. What is there, but
    broken or of other parameters, is said and made anew. Raises MiNtfError."""
    begin = time.perf_counter()
    if film:
        films.check(film[0])
    if tasks:
        files.make_folder(Path(tasks[0].folder))
    todo, again = [], []
    for task in tasks:
        wrong = _fault(task)
        if wrong is not None:
            todo.append(task)
            if wrong[0] != image_file.MISSING:
                again.append(wrong[1])
    for text in again:
        print(f"mi-ntf: made anew: {text}", file=sys.stderr)
    workers.check()
    seconds = [] if workers.here else _shared(todo, work, workers, quiet)
    todo_here = todo if workers.here else []
    with _bar(quiet or not todo_here, len(tasks)) as advance:
        advance(len(tasks) - len(todo_here))
        for task in todo_here:
            seconds.append(work(task)["seconds"])
            _join(task)
            advance(1)
    shown = {"film": str(film[0]), "toned": films.write(film[0], (t.whole for t in tasks if not t.part), *film[1:])
             } if film else {}
    return {"folder": tasks[0].folder if tasks else "", "images": len(tasks), "kept": len(tasks) - len(todo),
            "rendered": len(todo), "seconds": time.perf_counter() - begin,
            "first": seconds[0] if seconds else None,
            "each": float(np.median(seconds[1:])) if seconds[1:] else None, "each_of": seconds} | shown


def _shared(tasks: list[Task], work: Callable[[Task], dict[str, Any]], workers: Workers, quiet: bool) -> list[float]:
    """Seconds of the images, made by `workers`, in the order in which they came. Raises MiNtfError where some fail,
    after the others."""
    if not tasks:
        return []
    folder = Path(tasks[0].folder).absolute()
    sent = [replace(t, scene=str(Path(t.scene).absolute()), folder=str(folder)) for t in tasks]
    names = [t.path.name for t in tasks]
    seconds, failed = [], []
    with closing(each(work, sent, workers, title="frames", names=names, folder=folder, quiet=quiet)) as ends:
        for done in ends:
            if done.error:
                failed.append(done.error)
            else:
                seconds.append(done.value["seconds"])
                _join(tasks[done.index])
    if failed:
        raise MiNtfError(f"{len(failed)} of {len(tasks)} images failed, the others are done: {'; '.join(failed[:3])}. "
                         "Run the same command again once that is mended")
    return seconds


def print_summary(found: dict[str, Any]) -> None:
    """What :func:`run` returned, in a line."""
    print(f"{found['folder']}: {found['rendered']} of {found['images']} images in {found['seconds']:.1f} s, "
          f"{found['kept']} were there")
    if found["each"] is not None:
        print(f"the first in {found['first']:.2f} s, each of the others in {found['each']:.2f} s (median)")
    if "film" in found:
        print(f"{found['film']}: {found['toned']}")


def _fault(task: Task):
    """As :func:`mi_ntf.sequence.image_file.fault`; of a part of a frame that is whole, nothing."""
    name = key(task)
    wrong = image_file.fault(task.whole, name)
    return wrong if task.parts == 1 or wrong is None else image_file.fault(task.path, name, task.parts)


def _join(task: Task) -> None:
    """Write the whole frame and remove its parts, where this was the last of them to be made. Several processes may
    find that at a time: they write the same file."""
    if task.parts == 1:
        return
    paths = [replace(task, part=part).path for part in range(task.parts)]
    if not all(path.is_file() for path in paths):
        return
    name, record = key(task), dict[str, Any]()
    total: dict[str, np.ndarray] = {}
    for path in paths:
        try:
            channels, record = image_file.read(path)
        except MiNtfError:
            return  # no longer there
        if record["key"] != name or record.get("parts") != task.parts:
            return
        total = {n: total[n] + pixels if total else pixels for n, pixels in channels.items()}
    record = {n: record[n] for n in ("number", "of", "key")}
    image_file.write(task.whole, total, record)
    for path in paths:
        path.unlink(missing_ok=True)


def _bar(silent: bool, total: int):
    """A progress bar with time left on standard error; a function that advances it."""
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    @contextmanager
    def shown():
        with Progress(TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
                      TimeRemainingColumn(), console=Console(stderr=True), disable=silent) as progress:
            task = progress.add_task("frames", total=total)
            yield lambda count: progress.advance(task, count)

    return shown()

