"""Progress of long work on standard error, and the words that Ctrl-C leaves.

Work is done in stages. The title of a stage that counts is a plural noun, that of any other one says what is done::

    with progress.Stage("photographs", 120, done=12, then="the same command goes on") as stage:
        for view in views[12:]:
            photograph(view)
            stage.advance()

    with progress.Stage("training", seconds=60 * minutes - spent) as stage:
        stage.update(fraction, f"step {step}, loss {loss:.4f}")
        progress.say("step 40: validation 28.10 dB")  # a line that stays

A terminal shows one line, which is removed at the end of the stage: ``photographs: 12 of 120, 25 s left``. Elsewhere
the line is printed when the stage begins, and every ten seconds. Stages within others are appended to it. Within
:func:`silent`, which is `--json`, nothing is shown. A stage that gives way ends when the next one begins.

Time that is left is counted down from `seconds` if they are given. Otherwise it is estimated from the second update on,
since what is done first also compiles kernels.

A stage that Ctrl-C ends raises KeyboardInterrupt with a sentence, which the command line prints: ``stopped after 12 of
120 photographs; the same command goes on``. Code that knows better raises KeyboardInterrupt with its own sentence.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import TypeVar

from . import interruption
from .quantities import duration

S = TypeVar("S", bound="Stage")

BLINK, PLAIN = 0.25, 10.0
"""Seconds between two updates of a terminal's line, and between two plain lines."""
HEAVY = frozenset(("mitsuba", "drjit", "torch", "matplotlib", "scipy", "skimage", "cv2", "PIL", "viser", "OpenEXR"))
"""Packages that take long to import."""


class Stage:
    """Work that is shown while it lasts; the module's text shows its use.

    Parameters
    ----------
    title
        Plural noun for what is counted, or the work that is done: "photographs", "reading scene.xml".
    total
        Number of things that are counted.
    done
        Number of those that were there before.
    seconds
        Time that the work may take. 0: it is estimated.
    then
        End of the sentence after Ctrl-C: how to go on. By default it says that nothing was written.
    warm
        Number of things at the beginning that compile kernels, so that their time says nothing on that of the others.
    gives_way
        The stage is shown until another one begins, and has no sentence after Ctrl-C from then on.
    inner
        Show the stage within another one only, unless it has `write`. The other one has the sentence after Ctrl-C.
    shown
        False: show nothing.
    write
        Function for plain lines in place of standard error, the first after `interval` seconds.
    """

    def __init__(self, title: str, total: int = 0, *, done: int = 0, seconds: float = 0.0, then: str = "",
                 warm: int = 1, gives_way: bool = False, inner: bool = False, shown: bool = True,
                 write: Callable[[str], None] | None = None, interval: float = PLAIN) -> None:
        self.title, self.total, self.then, self.write, self.interval = title, total, then, write, interval
        self.done, self.text, self.gives_way = float(done), "", gives_way
        self._seconds, self._warm, self._inner, self._shown = seconds, done + warm if total else 0, inner, shown
        self._begin = self._last = time.monotonic()
        self.visible = False
        self._base: tuple[float, float] | None = None  # time and what was done, from which the rate is measured

    def __enter__(self: S) -> S:
        if self._shown:
            _shown.begin(self, self._inner)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
                 ) -> None:
        was_visible = self.visible
        _shown.end(self)
        if error is not None and interruption.caused(error) and (was_visible or not self.gives_way):
            if isinstance(error, KeyboardInterrupt) and (self._inner or (str(error) and not self.then)):
                return
            where = f"after {self.done:.0f} of {self.total} {self.title}" if self.total else f"while {self.title}"
            raise KeyboardInterrupt(f"stopped {where}; {self.then or 'nothing was written'}") from None

    def advance(self, text: str = "") -> None:
        """Count one thing more; `text` says what is done next."""
        self.update(self.done + 1, text)

    def update(self, done: float, text: str = "") -> None:
        """Set the number of things that are done, or the fraction of the work, and what is done now.

        Raises KeyboardInterrupt where Ctrl-C was pressed and lost in other code.
        """
        interruption.check()
        if done != self.done:
            self._last = time.monotonic()
            if done > 0 and (self._base is None or done <= self._warm):
                self._base = self._last, done
        self.done, self.text = done, text
        if self.visible:
            _shown.draw()

    def left(self) -> float | None:
        """Return the seconds that are left, None before there is an estimate."""
        now = time.monotonic()
        if self._seconds:
            return max(self._begin + self._seconds - now, 0.0)
        if self._base is None or self.done <= self._base[1]:
            return None
        each = (self._last - self._base[0]) / (self.done - self._base[1])
        rest = (self.total or 1.0) - self.done
        return max(rest * each - (now - self._last), (rest - 1) * each, 0.0)

    def line(self) -> str:
        """Return the line that describes the stage, without the time that is left."""
        count = f"{self.done:.0f} of {self.total}" if self.total else f"{self.done:.0%}" if self.done else ""
        more = ", ".join(filter(None, (count, self.text)))
        return f"{self.title}: {more}" if more else self.title

    def seconds(self) -> float:
        """Return the seconds since the stage began."""
        return time.monotonic() - self._begin


class _Shown:
    """The stages that are shown, the outermost first, and the thread that shows them."""

    def __init__(self) -> None:
        self.silent = False
        self.count = 0  # Number of stages that were shown so far
        self._stages: list[Stage] = []
        self._lock = threading.RLock()
        self._over = threading.Event()
        self._last_line = 0.0  # time of the last line
        self._width = 0  # characters that stand in the terminal's line

    def begin(self, stage: Stage, inner: bool) -> None:
        with self._lock:
            work = [earlier for earlier in self._stages if not earlier.gives_way]
            if self.silent or (inner and not work and not stage.write):
                return
            self.give_way()
            self._stages.append(stage)
            self.count += 1
            stage.visible = True
            try:
                if len(self._stages) == 1:
                    self._over = threading.Event()
                    threading.Thread(target=self._keep_drawing, args=(self._over, self._pace()), daemon=True).start()
                self.draw(len(self._stages) == 1 and not stage.write)
            except BaseException:
                self.end(stage)
                raise

    def give_way(self) -> None:
        """End the stages that give way, where other output begins."""
        for stage in [stage for stage in self._stages if stage.gives_way]:
            self.end(stage)

    def end(self, stage: Stage) -> None:
        with self._lock:
            if stage in self._stages:
                self._stages.remove(stage)
                stage.visible = False
                if not self._stages:
                    self._over.set()
                self.clear()

    def _terminal(self) -> bool:
        plain = os.environ.get("TERM") == "dumb" or (self._stages and self._stages[0].write)
        return not plain and sys.stderr.isatty()

    def _pace(self) -> float:
        return BLINK if self._terminal() else self._stages[0].interval

    def _keep_drawing(self, over: threading.Event, pace: float) -> None:
        while not over.wait(pace):
            self.draw(True)

    def draw(self, now: bool = False) -> None:
        """Show the stages; in a pipe only if the last line is old enough, or `now`."""
        with self._lock:
            clock = time.monotonic()
            if not self._stages or (not now and clock - self._last_line < self._pace()):
                return
            self._last_line, text = clock, self._text()
            if not self._terminal():
                (self._stages[0].write or _print)(text)
                return
            self.clear()
            room = (os.get_terminal_size(sys.stderr.fileno()).columns or 80) - 1
            text = text if len(text) <= room else f"…{text[1 - room:]}"
            sys.stderr.write(text)
            sys.stderr.flush()
            self._width = len(text)

    def _text(self) -> str:
        """Return the outermost and the innermost stage, with the time that is left, or else that has passed."""
        stages = [self._stages[0], *self._stages[1:][-1:]]
        lines = [stage.line() for stage in stages]
        passed = stages[0].seconds()
        for i, left in enumerate(stage.left() for stage in stages):
            if left is not None and left >= 0.5:
                lines[i] += f", {duration(round(left))} left"
                break
        else:
            lines[-1] += f", {duration(int(passed))} so far" if passed >= 1 else ""
        return " · ".join(lines)

    def clear(self) -> None:
        """Remove the terminal's line, so that another one can be printed."""
        with self._lock:
            if self._width:
                sys.stderr.write("\r\x1b[2K")
                sys.stderr.flush()
                self._width = 0


_shown = _Shown()
clear, give_way = _shown.clear, _shown.give_way


@contextmanager
def silent(yes: bool = True) -> Iterator[None]:
    """Show no progress within the block, unless `yes` is False."""
    before, _shown.silent = _shown.silent, _shown.silent or yes
    try:
        yield
    finally:
        _shown.silent = before


@contextmanager
def before_imports(title: str) -> Iterator[None]:
    """Show a stage within the block as soon as a package of :data:`HEAVY` is looked for, unless another came first."""
    count = _shown.count
    with ExitStack() as stack:
        class Finder:
            @staticmethod
            def find_spec(name: str, path: object = None, target: object = None) -> None:
                if name in HEAVY and _shown.count == count:
                    stack.enter_context(Stage(title, gives_way=True))

        sys.meta_path.insert(0, finder := Finder())
        stack.callback(sys.meta_path.remove, finder)
        yield


def say(text: str, warning: bool = False) -> None:
    """Print a line on standard error, above the progress. A warning is printed even if progress is silent."""
    if warning or not _shown.silent:
        clear()
        _print(text)


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
