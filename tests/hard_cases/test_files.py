"""Damaged files of every kind that is read: success or one sentence, whatever was done to them."""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
SEED = 20210922
SECONDS = 20
"""No file takes longer: what does is a hang."""
QUICK = {"field": 400, "voxels": 100, "grid": 200, "dataset": 200, "colmap": 200, "properties": 200, "maps": 100}
"""Files of each kind in the quick suite; the slow test reads ten times as many others."""


def batch(kind: str, seed: int, first: int, last: int, folder: Path) -> list[dict]:
    """Return the outcomes of the cases `first` to `last`.

    A process that dies is a failure of its last case, and another process continues after it.
    """
    command = [sys.executable, str(TESTS / "hard_cases" / "fuzz.py"), kind, *map(str, (seed, first, last)), str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(TESTS), "MI_NTF_CACHE": "off", "XDG_CACHE_HOME": str(folder)}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60 + SECONDS)
        end = f"died with {done.returncode}: {done.stderr[-2000:]}"
        lines = done.stdout.splitlines()
    except subprocess.TimeoutExpired as late:
        end, lines = "hangs", (late.stdout or b"").decode().splitlines()
    rows = [json.loads(line) for line in lines if line.startswith("{")]
    cases = [a | b for a, b in zip(rows[::2], rows[1::2], strict=False)]
    if len(rows) % 2:
        cases.append(rows[-1] | {"outcome": "no end", "text": end, "seconds": 0})
    assert cases, end
    reached = first + len(cases)
    return cases if reached >= last else cases + batch(kind, seed, reached, last, folder)


def faults(row: dict) -> str:
    """Return the fault in the outcome of a case, or an empty text."""
    if row["outcome"] not in ("read", "refused"):
        return row["outcome"]
    if row["outcome"] == "refused" and ("\n" in row["text"] or not 20 < len(row["text"]) < 2000):
        return "not one sentence"
    return "slow" if row["seconds"] > SECONDS else ""


def check(kind: str, seed: int, count: int, folder: Path) -> None:
    rows = [row for k in range(0, count, 200) for row in batch(kind, seed, k, min(count, k + 200), folder)]
    failed = [row | {"fault": faults(row)} for row in rows if faults(row)]
    kinds = Counter((row["fault"], row["text"][:60]) for row in failed)
    shown = "\n".join(f"{n}x {fault}: {text!r}" for (fault, text), n in kinds.most_common(40))
    assert not failed, f"{len(failed)} of {count} {kind} files, seed {seed}:\n{shown}\nfirst: {failed[0]}"
    assert len(rows) == count and not list(folder.rglob("EXECUTED"))
    outcomes = Counter(row["outcome"] for row in rows)
    assert outcomes["refused"] > count / 4, "the damage is worth its name"


@pytest.mark.parametrize("kind", QUICK)
def test_damaged_files(kind, tmp_path):
    check(kind, SEED, QUICK[kind], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", QUICK)
def test_many_damaged_files(kind, tmp_path):
    check(kind, SEED + 1, 10 * QUICK[kind], tmp_path)
