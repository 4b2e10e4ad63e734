"""Frames from a CSV table: names of the scene's parameters in the first line, the values of one frame per line below.

An empty cell leaves the scene's default.
"""

import csv
from pathlib import Path

from ..core.errors import MiNtfError
from .timeline import Frame, Timeline


def read(path: str | Path, fixed: dict[str, str] | None = None) -> Timeline:
    """Return the frames of the CSV file `path` (UTF-8), numbered from 0.

    `fixed` has values of $names, which override those of the file. Raises MiNtfError that names the line.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            rows = [(reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise MiNtfError(f"parameters {path} cannot be read ({error.strerror}); give a CSV file") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise MiNtfError(f"parameters {path} is no CSV file: {error}") from None
    if len(rows) < 2:
        raise MiNtfError(f"parameters {path} has {len(rows)} lines that are not empty, expected names and, below them, "
                         "one line per frame")
    names = [name.strip() for name in rows[0][1]]
    for name in names:
        if not name or name.startswith("$") or names.count(name) > 1:
            raise MiNtfError(f"parameters {path}: the first line has the name {name!r}, expected each $name of the "
                             "scene once, without the $")
    frames: list[Frame] = []
    for line, row in rows[1:]:
        if len(row) != len(names):
            raise MiNtfError(f"parameters {path}, line {line}: {len(row)} values for {len(names)} names")
        values = {name: value.strip() for name, value in zip(names, row, strict=True) if value.strip()}
        frames.append(Frame(len(frames), values | (fixed or {})))
    return Timeline(frames)
