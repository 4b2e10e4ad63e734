"""Options and output that several commands share."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from tyro.conf import UseAppendAction, arg

from mi_ntf.core.errors import MiNtfError
from mi_ntf.jobs.options import Workers

Report = TypeVar("Report")
WorkerOptions = Annotated[Workers, arg(name="")]
Output = Annotated[Path, arg(aliases=("-o",), metavar="FILE")]
OptionalOutput = Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")]
Json = Annotated[bool, arg(help="Print JSON in place of tables and progress.")]
Define = Annotated[UseAppendAction[tuple[str, ...]],
                   arg(aliases=("-D",), metavar="KEY=VALUE", help="Value of $KEY in the scene.")]
Masks = Annotated[Path | None, arg(help="Folder of masks with the names of the photographs (white: object).")]
Background = Annotated[str | None, arg(
    help="Set to black for photographs without masks that were taken with a flash in a dark room.")]
FlashOffset = Annotated[str | None, arg(metavar="R,U,F")]


class UsageError(Exception):
    """Arguments that parse but do not fit together (exit code 2)."""


def parse_offset(text: str | None) -> tuple[float, float, float] | None:
    """Return the offset "right,up,forward" of the flash from the lens as numbers."""
    if text is None:
        return None
    try:
        right, up, forward = map(float, text.split(","))
    except ValueError:
        raise UsageError(f"--flash-offset is '{text}', expected three numbers right,up,forward (write "
                         "--flash-offset=-1,2,0 where the first is negative)") from None
    return right, up, forward


def check_workers(workers: Workers) -> None:
    """Raise UsageError for options of workers that do not fit together."""
    try:
        workers.check()
    except MiNtfError as error:
        raise UsageError(str(error)) from None


def definitions(items: Sequence[str]) -> dict[str, str]:
    """Return the values of ``$names`` by name, from words KEY=VALUE."""
    if not all("=" in item for item in items):
        raise UsageError(f"-D needs KEY=VALUE, got {' '.join(items)}")
    return dict(item.split("=", 1) for item in items)


def print_report(report: Report, as_json: bool, print_table: Callable[[Report], None]) -> None:
    """Print the result of a command as JSON, or for a reader by `print_table`."""
    if as_json:
        data = asdict(report) if is_dataclass(report) and not isinstance(report, type) else report
        print(json.dumps(data, indent=2, default=str))
    else:
        print_table(report)


def print_pairs(values: Mapping[str, object], indent: str = "") -> None:
    """Print a mapping, one `key  value` a line, nested mappings indented."""
    width = max((len(str(key)) for key in values), default=0)
    for key, value in values.items():
        if isinstance(value, dict):
            print(f"{indent}{key}")
            print_pairs(value, indent + "  ")
        else:
            print(f"{indent}{key:<{width}}  {value}")
