"""Tasks for workers, in a module of their own so that other processes find them."""

import os
import signal
import time
from pathlib import Path

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import capture


def square(task: int) -> int:
    return task * task


def place(task) -> tuple[int, dict]:
    """Return the process, and the settings with which it was started."""
    import drjit

    names = ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES")
    return os.getpid(), {name: os.environ.get(name) for name in names} | {"drjit": drjit.thread_count()}


def write(task: tuple[Path, int]) -> int:
    """Make a file for each attempt; 3 fails always, 5 once, 7 kills its process once, 9 always."""
    folder, number = task
    attempts = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{attempts}").touch()
    if number == 3 or (number == 5 and not attempts):
        raise MiNtfError("this is none of mine; give another")
    if number == 9 or (number == 7 and not attempts):
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def die(task) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def sleep(task: Path) -> None:
    task.write_text(str(os.getpid()))
    time.sleep(60)


def unsendable(task):
    return lambda: task


def read(task: Path) -> tuple[int, ...]:
    """Shape of an image, by Mitsuba."""
    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    return np.array(mi.Bitmap(str(task))).shape


def photograph(task) -> None:
    """Make a view of a capture; the first process that comes to frame 5 is killed as by `kill -9` before it."""
    request, index = task
    mark = request.out.parent / "killed"
    if index == 5 and not mark.exists():
        mark.touch()
        die(task)
    capture.photograph(task)
