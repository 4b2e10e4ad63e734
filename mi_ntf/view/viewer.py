"""The loop of a view: changes from the browser, previews while they come, passes when they end."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mi_ntf.core.errors import MiNtfError, sentence

from .display import bytes_of, split
from .picture import Interrupted
from .session import Frame, Session

REST = 0.25
"""Seconds after the last change from which the picture is refined."""
SLOW, FAST = 0.2, 0.04
"""Seconds of a preview: slower ones get coarser, faster ones finer."""
COARSEST = 4
PASS = 0.4
"""Seconds that a pass of several samples may take."""


class Viewer:
    """Turns changes of `session` into pictures for `show`, all in the thread that calls :meth:`run`.

    show    ``(bytes (h, w, 3), status)``: puts up a picture and a line of text
    tell    called with a line of text, the answer to something that was asked or a mistake
    samples a pixel that a picture at rest gets
    """

    def __init__(self, session: Session, show: Callable[[np.ndarray, str], None], tell: Callable[[str], None],
                 samples: int = 64):
        self.session, self.show, self.tell, self.samples = session, show, tell, samples
        self.stops, self.share = 0.0, 0.5
        self.frames: list[tuple[str, float]] = []  # kind of change and seconds of the latest previews
        self._divisors = {"camera": 2}
        self._slow = 0
        self._changes: dict[str, tuple[str, Callable[[], Any]]] = {}
        self._lock, self._news, self._ended = threading.Lock(), threading.Event(), False
        self._last, self._frame = 0.0, None  # type: tuple[float, Frame | None]
        self._each = 0.0
        session.stop = lambda: bool(self._changes) or self._ended

    def change(self, name: str, do: Callable[[], Any], kind: str = "other") -> None:
        """Do `do()` before the next picture; a later change of the same `name` takes the place of one that waits.
        `kind`: ``camera``, ``light`` or ``other``, which says how coarse the preview gets. From any thread."""
        with self._lock:
            self._changes.pop(name, None)
            self._changes[name] = kind, do
        self._news.set()

    def stop(self) -> None:
        """End :meth:`run`."""
        self._ended = True
        self._news.set()

    def run(self) -> None:
        """Until :meth:`stop`."""
        while not self._ended:
            if not self.step():
                self._news.wait(0.05 if self._unrefined() else None)
            self._news.clear()

    def step(self) -> bool:
        """One picture, if there is one to make; whether there was."""
        with self._lock:
            changes, self._changes = self._changes, {}
        try:
            if changes:
                self._preview(changes)
                return True
            if not self._unrefined() or time.monotonic() - self._last < REST:
                return False
            self._refine()
            return True
        except Interrupted:
            return True
        except (MiNtfError, RuntimeError, OSError) as error:
            self._frame = None
            self.tell(f"Error: {sentence(error)}")
            return True

    def again(self) -> None:
        """Put up the latest picture as exposure and slider are now."""
        if self._frame is not None:
            self._put(self._frame)

    def _unrefined(self) -> bool:
        return self._frame is not None and self._frame.samples < self.samples

    def _preview(self, changes: dict) -> None:
        kinds = {kind for kind, _ in changes.values()}
        for _, do in changes.values():
            do()
        if kinds <= {"shown"}:
            self.again()
            return
        kind = next((k for k in ("camera", "light") if k in kinds), "other")
        divisor = self._divisors.get(kind, 1)
        self._frame = self.session.preview(divisor)
        self._last = time.monotonic()
        self.frames = [*self.frames[-99:], (kind, self._frame.seconds)]
        self._put(self._frame)
        self._adapt(kind, divisor, self._frame.seconds)

    def _adapt(self, kind: str, divisor: int, seconds: float) -> None:
        """The divisor of the next preview; one slow frame may have compiled something."""
        self._slow = self._slow + 1 if seconds > SLOW else 0
        if self._slow > 1 and divisor < COARSEST:
            self._divisors[kind], self._slow = 2 * divisor, 0
        elif seconds < FAST and divisor > 1:
            self._divisors[kind] = divisor // 2

    def _refine(self) -> None:
        done = self._frame.samples if self._frame and self.session.refined else 0
        spp = int(min(max(PASS / self._each, 1), 16)) if self._each and done else 1
        spp = max(1, min(spp, self.samples - done))
        self._frame = self.session.refine(spp)
        # The first pass makes maps and may compile.
        self._each = self._frame.seconds / spp if done else 0.0
        self._put(self._frame)

    def _put(self, frame: Frame) -> None:
        picture = bytes_of(frame.image, self.session.shown, self.stops)
        if frame.right is not None:
            picture = split(picture, bytes_of(frame.right, self.session.shown, self.stops), self.share)
        height, width = picture.shape[:2]
        rate = f"{1e3 * frame.seconds:.0f} ms"
        self.show(picture, f"{width}×{height}, {frame.samples} samples a pixel, {rate} "
                           f"{'the last pass' if self.session.refined else 'a frame'}")
