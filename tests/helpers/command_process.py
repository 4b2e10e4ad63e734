"""A process that runs many commands and scripts, so that they share imports, kernels and fields.

The parent writes one JSON list of words a line, and reads `[exit code, printed text]` for each.
"""

import json
import os
import runpy
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path


class CommandProcess:
    """Runs `mi-ntf …` and `python …` in one process in a folder, with further environment variables."""

    def __init__(self, folder: Path, **environment: str):
        tests = Path(__file__).parents[1]
        paths = [str(tests), str(tests.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "helpers.command_process"], cwd=folder, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True,
            env={**os.environ, **environment, "PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "agg"})

    def run(self, *words: str) -> tuple[int, str]:
        """Run a command and return its exit code and all that it printed."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        assert answer, f"the process ended with exit code {self.process.wait()} during {' '.join(words)}"
        code, text = json.loads(answer)
        return code, text

    def close(self) -> None:
        """End the process."""
        self.process.communicate(timeout=60)


def _run(words: Sequence[str]) -> int:
    if words[0] == "mi-ntf":
        from mi_ntf.cli import main

        return main(words[1:])
    assert words[0] == "python", words
    former, sys.argv, path = sys.argv, list(words[1:]), sys.path[:]
    try:
        if words[1] == "-m":
            sys.argv = list(words[2:])
            runpy.run_module(words[2], run_name="__main__", alter_sys=True)
        else:
            sys.path.insert(0, str(Path(words[1]).parent.absolute()))  # as of a script that Python runs
            runpy.run_path(words[1], run_name="__main__")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except Exception:
        traceback.print_exc()
        return 1
    finally:
        sys.argv, sys.path[:] = former, path
    return 0


def _serve() -> None:
    answers = os.fdopen(os.dup(1), "w")
    with tempfile.TemporaryFile("w+") as printed:
        os.dup2(printed.fileno(), 1)
        os.dup2(printed.fileno(), 2)
        for line in sys.stdin:
            folder = Path.cwd()
            os.ftruncate(1, 0)
            os.lseek(1, 0, os.SEEK_SET)
            code = _run(json.loads(line))
            sys.stdout.flush()
            sys.stderr.flush()
            os.chdir(folder)
            printed.seek(0)
            answers.write(json.dumps([code, printed.read()]) + "\n")
            answers.flush()


if __name__ == "__main__":
    _serve()
