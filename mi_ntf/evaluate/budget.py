"""A budget of seconds: its text, and the progress of work that has one."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

from ..core.errors import MiNtfError

Tell: TypeAlias = Callable[[float, str, bool], None]
"""Function of the seconds spent so far, the work that is done now, and True for a line that stays."""


def seconds(text: str) -> float:
    """Return the seconds of a text such as 90s, 5m or 1h. Raises MiNtfError."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([smh])", text.strip())
    value = float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
    if value < 1:
        raise MiNtfError(f"--budget is '{text}', expected a time of a second or more such as 90s, 5m or 1h")
    return value


@contextmanager
def progress(budget: float, quiet: bool = False) -> Iterator[Tell]:
    """Show the used part of `budget` seconds and the work that is done now on stderr, unless `quiet`."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True, quiet=quiet)
    columns = (TextColumn("{task.completed:.0f} of {task.total:.0f} s"), BarColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=budget)

        def tell(seconds: float, text: str, done: bool) -> None:
            bar.update(task, completed=min(seconds, budget), description=escape(text))
            if done:
                console.print(f"{seconds:5.0f} s  {text}", highlight=False, markup=False, soft_wrap=True)

        yield tell
