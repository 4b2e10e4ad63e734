"""Run the programs of this environment as a user does."""

import os
import subprocess
import sys
from pathlib import Path


def run_program(*words: str | Path, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program of this environment (`mitsuba`, `mi-ntf`, `python`) and return text and exit status."""
    return subprocess.run(
        _command(words), cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300
    )


def run_on_one_core(*words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The same, with a single core for the program."""
    core = min(os.sched_getaffinity(0))
    return subprocess.run(_command(words), cwd=cwd, capture_output=True, text=True, timeout=120,
                          preexec_fn=lambda: os.sched_setaffinity(0, {core}))


def _command(words: tuple[str | Path, ...]) -> list[str]:
    return [str(Path(sys.executable).parent / words[0]), *map(str, words[1:])]
