"""Reports of a run while it trains: divergence, notes, TensorBoard, pictures in a browser."""

import math
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import torch

from ..core import progress
from ..core.errors import MiNtfError

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class Validation(TypedDict):
    """Entry of the validation history."""

    step: int
    psnr: float  # dB


class Fault(MiNtfError):
    """A step that must not count: a loss, gradient or parameter that is not finite, or a loss that runs away."""


class Watch:
    """Running averages of losses, which detect that one of them has diverged."""

    FACTOR = 20.0  # Ratio of a loss to its running average above which it is suspect …
    PATIENCE = 10  # … and the number of such steps in a row that are a fault. Single outliers are common and harmless
    FLOOR = 1e-3  # Least average. Losses are of exposed colours and of τ, both of order 1, so 0.02 is small

    def __init__(self) -> None:
        self.averages: dict[str, tuple[float, int]] = {}
        """Running average over about 50 steps and number of suspect steps in a row, by name of the loss."""

    def check(self, name: str, value: float, step: int) -> None:
        """Record the loss `name`. Raises Fault."""
        if not math.isfinite(value):
            raise Fault(f"the {name} loss is {value} at step {step}")
        average, suspect = self.averages.get(name, (value, 0))
        if value > self.FACTOR * max(average, self.FLOOR):
            suspect += 1
        else:
            average, suspect = 0.98 * average + 0.02 * value, 0
        self.averages[name] = (average, suspect)
        if suspect >= self.PATIENCE:
            raise Fault(f"the {name} loss is {value:.3g} at step {step}, over {self.FACTOR:g} times its running "
                        f"average {average:.3g} for {suspect} steps")


class Notes:
    """Sentences on the photographs, printed once each and kept for the report; `shown`: this process prints them."""

    def __init__(self, shown: bool):
        self.shown = shown
        self.texts: list[str] = []

    def add(self, text: str) -> None:
        """Print `text` if it is new, and keep it."""
        if text not in self.texts:
            self.texts.append(text)
            if self.shown:
                progress.say(text, text.startswith("warning: "))


class Log:
    """TensorBoard events in `folder` (None: no events), and with `view` pictures in a browser."""

    def __init__(self, folder: Path | None, view: bool = False):
        self.folder, self.live = folder, None
        if view:
            from .live import Live

            self.live = Live()
            progress.say(f"Open {self.live.address} in a browser to watch the field.")
        self.writer: SummaryWriter | None = None
        self.last = (time.monotonic(), 0, 0)
        if folder is not None:
            try:
                import torch.utils.tensorboard  # noqa: F401
            except ImportError as error:
                raise MiNtfError(f"--tensorboard {folder} needs the package tensorboard ({error}); "
                                 "pip install 'mi-ntf[train]'") from None

    def start(self, step: int) -> None:
        """Open the folder; events of an interrupted run from `step` on are superseded."""
        if self.folder is not None:
            from torch.utils.tensorboard import SummaryWriter

            self.writer = SummaryWriter(str(self.folder), purge_step=step)
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

    def show(self, step: int, psnr: float, picture: Callable[[], torch.Tensor]) -> None:
        """Show ``picture()`` in the browser, if one is open; `psnr` is that of the last validation, dB."""
        if self.live is not None:
            self.live.show(step, psnr, picture)

    def validated(self, entry: Validation, picture: Callable[[], torch.Tensor]) -> None:
        """Write the PSNR of `entry` and a picture (h, w, 3) of photograph, prediction and normals, side by side."""
        if self.writer is None:
            return
        self.writer.add_scalar("validation/PSNR dB", entry["psnr"], entry["step"])
        self.writer.add_image("validation/photograph, prediction, normals", picture(), entry["step"],
                              dataformats="HWC")
        self.writer.flush()

    def close(self) -> None:
        """Close the folder and the page."""
        if self.writer is not None:
            self.writer.close()
        if self.live is not None:
            self.live.close()


def memory() -> float:
    """Return the largest memory that this process has held so far, GiB."""
    unit = 2**30 if sys.platform == "darwin" else 2**20  # bytes there, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
