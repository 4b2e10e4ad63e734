"""Every script that feeds a page, one after the other.

    python -m benchmarks.all [--only NAME …]

A script is skipped if its results are of the last commit that changed the code. Former results are kept in
``benchmarks/results/history``. At the end the tables of the pages are written. Takes about two hours on two cores, on
which nothing else should run.
"""

import argparse
import json
import subprocess
import sys

from . import record, tables

SCRIPTS: dict[str, list[str]] = {"demo": ["--results"], "speed": [], "loops": [], "fields": [], "sequence": [],
                                 "dial": [], "splats": [], "reproduce": [], "smoke": []}
"""Name of each script → its arguments. `media` and `objects` are left out: the first needs Mitsuba's scenes, the second
8 hours."""


def current(name: str) -> bool:
    """Return True if the results of a script are of the code as it is now."""
    path, commit = record.RESULTS / f"{name}.json", record.commit()
    if not path.is_file() or commit.endswith("+"):
        return False
    return bool(json.loads(path.read_text(encoding="utf-8"))["about"]["commit"] == commit)


def main() -> int:
    """Run the scripts; the exit code is 1 if one of them fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SCRIPTS, default=list(SCRIPTS))
    failed = []
    for name in parser.parse_args().only:
        if current(name):
            print(f"{name}: its results are of this commit")
            continue
        print(f"{name}: begins", flush=True)
        if subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *SCRIPTS[name]], cwd=record.ROOT).returncode:
            failed.append(name)
            print(f"{name}: failed")
    for page in tables.different(write=True):
        print(f"{page}: brought up to date")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
