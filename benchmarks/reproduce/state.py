"""What is done: a file of JSON lines, one a finished job, that outlives kills.

    {"job": "statue/point-000/TM", "about": "9f…", "metrics": {…}, "seconds": 6.1}
    {"job": "statue/point-001/TM", "about": "9f…", "error": "…"}

A line is written with one system call and brought to the disk before the next job begins. What a kill left of a line
that was being written is cut off by the next run.
"""

import fcntl
import hashlib
import json
import os
from pathlib import Path
from typing import Any

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError

NAME = "jobs.jsonl"


def fingerprint(about: Any) -> str:
    """A short hash of everything, JSON, that decides a job's result: rows of other settings do not count."""
    text = json.dumps(about, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class State:
    """Rows of the folder `out` by job. One process at a time: raises MiNtfError while another one holds it."""

    def __init__(self, out: Path):
        files.make_folder(out)
        self.path = Path(out) / NAME
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise MiNtfError(f"cannot write {self.path} ({error.strerror}); choose another place with -o") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise MiNtfError(f"another run is at work in {out}; wait for it, or choose another folder with "
                             "-o") from None
        self.rows: dict[str, dict] = {}
        self._read()

    def __enter__(self) -> "State":
        return self

    def __exit__(self, *_) -> None:
        os.close(self._file)

    def done(self, job: str, about: str) -> bool:
        """Whether `job` was finished with these settings, without an error."""
        row = self.rows.get(job)
        return row is not None and row["about"] == about and "error" not in row

    def add(self, row: dict) -> None:
        """Keep a row, on the disk when this returns. Raises MiNtfError where the disk is full."""
        line = (json.dumps(row) + "\n").encode()
        try:
            if os.write(self._file, line) < len(line):
                raise OSError(0, "the disk is full")
            os.fsync(self._file)
        except OSError as error:
            raise MiNtfError(f"cannot write {self.path} ({error.strerror}); free space there and run again") from None
        self.rows[row["job"]] = row

    def _read(self) -> None:
        content = self.path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):  # of a run that was killed within a line
            os.ftruncate(self._file, whole)
        for number, line in enumerate(content[:whole].splitlines(), 1):
            try:
                row = json.loads(line)
                self.rows[row["job"]] = {"about": row["about"]} | row
            except (ValueError, KeyError, TypeError):
                raise MiNtfError(f"{self.path}, line {number}, is no row of a run; delete that line, or choose another "
                                 "folder with -o") from None
