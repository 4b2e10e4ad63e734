"""What a run tells while it trains: divergence, progress in the terminal, TensorBoard."""

import math
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ..core.errors import MiNtfError


class Fault(MiNtfError):
    """A step that must not count: a loss, gradient or parameter that is not finite, or a loss that runs away."""


class Watch:
    """Running averages of losses, and from them the verdict that one has diverged."""

    FACTOR = 20.0
    """A loss so many times its running average is suspect …"""
    PATIENCE = 10
    """… and so many such steps in a row are a fault. Single outliers, one bad batch, are common and harmless."""
    FLOOR = 1e-3
    """Averages under this count as this. Losses are of exposed colours and of τ, both of order 1, so 0.02 is small."""

    def __init__(self) -> None:
        self.seen: dict[str, list[float]] = {}
        """Name → running average over some 50 steps, suspect steps in a row."""

    def check(self, name: str, value: float, step: int) -> None:
        """Take note of the loss `name`. Raises Fault."""
        if not math.isfinite(value):
            raise Fault(f"the {name} loss is {value} at step {step}")
        average, suspect = self.seen.get(name, [value, 0])
        if value > self.FACTOR * max(average, self.FLOOR):
            suspect += 1
        else:
            average, suspect = 0.98 * average + 0.02 * value, 0
        self.seen[name] = [average, suspect]
        if suspect >= self.PATIENCE:
            raise Fault(f"the {name} loss is {value:.3g} at step {step}, over {self.FACTOR:g} times its running "
                        f"average {average:.3g} for {suspect} steps")


class Display:
    """Progress bar with time left, of a run with loss, validation PSNR and memory, on standard error; silent unless
    `shown`. `what`: its name."""

    RUN = "step {task.fields[step]}  loss {task.fields[loss]:.4f}  val {task.fields[psnr]:.2f} dB  "

    def __init__(self, shown: bool, what: str = "train"):
        columns = (TextColumn(what), BarColumn(), TextColumn("{task.percentage:3.0f}%"),
                   TextColumn((self.RUN if what == "train" else "") + "{task.fields[memory]:.1f} GiB"),
                   TimeRemainingColumn())
        self.bar = Progress(*columns, console=Console(stderr=True, quiet=not shown), disable=not shown)
        self.task = self.bar.add_task(what, total=1.0, step=0, loss=0.0, psnr=float("nan"), memory=0.0)

    def __enter__(self) -> "Display":
        self.bar.__enter__()
        return self

    def __exit__(self, *reason) -> None:
        self.bar.__exit__(*reason)

    def update(self, progress: float, step: int = 0, loss: float = 0.0) -> None:
        self.bar.update(self.task, completed=progress, step=step, loss=loss, memory=memory())

    def validated(self, entry: dict) -> None:
        self.bar.update(self.task, psnr=entry["psnr"])
        self.say(f"step {entry['step']}: validation {entry['psnr']:.2f} dB")

    def say(self, text: str) -> None:
        """A line above the bar."""
        self.bar.console.print(text, highlight=False, soft_wrap=True)


class Log:
    """TensorBoard events in `folder`, none where it is None; `view`: pictures in a browser."""

    def __init__(self, folder: Path | None, view: bool = False):
        self.folder, self.live = folder, None
        if view:
            from .live import Live

            self.live = Live()
            note(f"Open {self.live.address} in a browser to watch the field.")
        self.writer: Any = None
        self.last = (time.monotonic(), 0, 0)
        if folder is not None:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise MiNtfError(f"--tensorboard {folder} needs the package tensorboard ({error}); "
                                 "pip install 'mi-ntf[train]'") from None
            self.writer_class = SummaryWriter

    def start(self, step: int) -> None:
        """Open the folder; events of an interrupted run from `step` on are superseded."""
        if self.folder is not None:
            self.writer = self.writer_class(str(self.folder), purge_step=step)
            self.last = (time.monotonic(), 0, 0)

    def scalars(self, step: int, values: dict[str, float], rays: int, samples: int) -> None:
        """Write `values`, the memory, and the speed, from the `rays` and `samples` that this process has trained on."""
        if self.writer is None:
            return
        now = (time.monotonic(), rays, samples)
        elapsed = max(now[0] - self.last[0], 1e-9)
        rates = {"speed/rays per second": (rays - self.last[1]) / elapsed,
                 "speed/samples per second": (samples - self.last[2]) / elapsed, "memory GiB": memory()}
        self.last = now
        for name, value in (values | rates).items():
            self.writer.add_scalar(name, value, step)

    def look(self, step: int, psnr: float, picture: Callable[[], torch.Tensor]) -> None:
        """Let those who watch see ``picture()``; `psnr`: of the last validation, dB."""
        if self.live is not None:
            self.live.show(step, psnr, picture)

    def validated(self, entry: dict, picture: Callable[[], torch.Tensor]) -> None:
        """Write the PSNR of `entry` and a picture (h, w, 3) of photograph, prediction and normals, side by side."""
        if self.writer is None:
            return
        self.writer.add_scalar("validation/PSNR dB", entry["psnr"], entry["step"])
        self.writer.add_image("validation/photograph, prediction, normals", picture(), entry["step"],
                              dataformats="HWC")
        self.writer.flush()

    def close(self) -> None:
        if self.writer is not None:
            self.writer.close()
        if self.live is not None:
            self.live.close()


def note(text: str) -> None:
    """Tell the user `text`, on standard error as all that is said while a run lasts."""
    print(text, file=sys.stderr)


def memory() -> float:
    """Largest memory that this process has held so far, GiB."""
    unit = 2**30 if sys.platform == "darwin" else 2**20  # bytes there, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
