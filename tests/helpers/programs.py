"""Run the programs of this environment as a user does."""

import os
import subprocess
import sys
from pathlib import Path


def run_program(*words: str | Path, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program of this environment (`mitsuba`, `mi-ntf`, `python`) and return text and exit status."""
    program = Path(sys.executable).parent / words[0]
    command = [str(program), *map(str, words[1:])]
    return subprocess.run(
        command, cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300
    )
