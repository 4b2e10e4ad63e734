"""The loop of a view: changes from the browser, previews while they come, refinement when they end."""

import math
import threading
import time
from collections.abc import Callable, Mapping

from numpy.typing import ArrayLike

from mi_ntf.core.errors import MiNtfError, sentence

from . import labels
from .display import Bytes, bytes_of, split
from .picture import Interrupted
from .session import Frame, Session

REST = 0.25
"""Seconds from the last change to the first refinement."""
SLOW, FAST = 0.2, 0.08
"""Seconds of a preview above which the next ones get coarser, and below which they get finer.

A finer one has twice the pixels, so that it is still no slow one.
"""
FINER = 2**0.5
"""Ratio of successive divisors. There are few of them, since kernels are compiled for each size."""
COARSEST = 8.0
"""Largest divisor of the picture's width and height."""
PASS = 0.4
"""Seconds that a pass of several samples may take."""


class Viewer:
    """Turns changes of `session` into pictures, all in the thread that calls :meth:`run`.

    show     ``(picture, status)`` displays a picture and two lines of text
    tell     displays a line of text, an answer or an error
    samples  samples per pixel at which refinement ends
    lights   returns names and positions of lights to which the picture points if they are off view
    """

    def __init__(self, session: Session, show: Callable[[Bytes, str], None], tell: Callable[[str], None],
                 samples: int = 64, lights: Callable[[], Mapping[str, ArrayLike]] = dict) -> None:
        self.session, self.show, self.tell, self.samples, self.lights = session, show, tell, samples, lights
        self.stops, self.split = 0.0, 0.5
        self._divisors = {"camera": 2.0, "light": 2.0}
        self._slow_previews, self._is_coarse = 0, False
        self._changes: dict[str, tuple[str, Callable[[], object]]] = {}
        self._lock, self._news, self._ended = threading.Lock(), threading.Event(), False
        self._last_change = 0.0
        self._frame: Frame | None = None
        self._seconds_per_sample = 0.0
        session.stop = lambda: bool(self._changes) or self._ended

    def change(self, name: str, do: Callable[[], object], kind: str = "other") -> None:
        """Call `do` before the next picture. May be called from any thread.

        A later change of the same `name` replaces one that waits. `kind` is ``camera``, ``light``, ``other``, or
        ``shown`` for changes that need no new picture. The preview's resolution depends on it.
        """
        with self._lock:
            self._changes.pop(name, None)
            self._changes[name] = kind, do
        self._news.set()

    def stop(self) -> None:
        """End :meth:`run`."""
        self._ended = True
        self._news.set()

    def run(self) -> None:
        """Render until :meth:`stop`."""
        while not self._ended:
            if not self.step():
                self._news.wait(0.05 if self._is_unrefined() else None)
            self._news.clear()

    def step(self) -> bool:
        """Make one picture. Return False if there is nothing to do."""
        with self._lock:
            changes, self._changes = self._changes, {}
        try:
            if changes:
                self._preview(changes)
                return True
            if not self._is_unrefined() or time.monotonic() - self._last_change < REST:
                return False
            if self._is_coarse:  # the first pass may take seconds
                self._render_preview(1.0)
            else:
                self._refine()
            return True
        except Interrupted:
            return True
        except (MiNtfError, RuntimeError, OSError) as error:
            self._frame = None
            self.tell(f"Error: {sentence(error)}")
            return True

    def _is_unrefined(self) -> bool:
        return self._frame is not None and self._frame.samples < self.samples

    def _preview(self, changes: dict[str, tuple[str, Callable[[], object]]]) -> None:
        kinds = {kind for kind, _ in changes.values()}
        for _, do in changes.values():
            try:
                do()
            except (MiNtfError, RuntimeError, OSError) as error:  # such as a file that exists; the picture stays
                self.tell(f"Error: {sentence(error)}")
        if kinds <= {"shown"}:
            if self._frame is not None:
                self._display(self._frame)
            return
        kind = next((k for k in ("camera", "light") if k in kinds), "other")
        divisor = self._divisors.get(kind, 1.0)
        seconds = self._render_preview(divisor)
        self._last_change = time.monotonic()
        self._adapt(kind, divisor, seconds)

    def _render_preview(self, divisor: float) -> float:
        """Show a preview, and return the seconds that it took."""
        self._frame, self._is_coarse = self.session.preview(divisor), divisor > 1
        self._display(self._frame)
        return self._frame.seconds

    def _adapt(self, kind: str, divisor: float, seconds: float) -> None:
        """Set the divisor of the next preview. A single slow preview may have compiled kernels."""
        self._slow_previews = self._slow_previews + 1 if seconds > SLOW else 0
        if self._slow_previews > 1:
            steps = math.ceil(math.log(seconds / SLOW, FINER**2))  # the time goes with the number of pixels
            self._divisors[kind], self._slow_previews = min(divisor * FINER**steps, COARSEST), 0
        elif seconds < FAST:
            self._divisors[kind] = max(divisor / FINER, 1.0)

    def _refine(self) -> None:
        done = self._frame.samples if self._frame and self.session.refined else 0
        spp = int(min(max(PASS / self._seconds_per_sample, 1), 16)) if self._seconds_per_sample and done else 1
        spp = max(1, min(spp, self.samples - done))
        self._frame = self.session.refine(spp)
        # The first pass makes maps and may compile.
        self._seconds_per_sample = self._frame.seconds / spp if done else 0.0
        self._display(self._frame)

    def _display(self, frame: Frame) -> None:
        picture = bytes_of(frame.image, self.session.aov, self.stops)
        height, width = picture.shape[:2]
        if frame.right is not None:
            picture = split(picture, bytes_of(frame.right, self.session.aov, self.stops), self.split)
        aspect = self.session.size[0] / self.session.size[1]
        off_view = {name: place for name, position in self.lights().items()
                    if (place := labels.direction(position, self.session.pose, aspect)) is not None}
        picture = labels.labelled(picture, self.session.size, frame.methods, self.split, off_view)
        self.show(picture, f"{width}×{height}, {frame.samples} sample{'s' if frame.samples > 1 else ''} a pixel, "
                           f"{1e3 * frame.seconds:.0f} ms\n{' | '.join(frame.methods)}")
