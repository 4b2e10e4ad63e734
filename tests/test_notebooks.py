"""Every notebook of the documentation runs within its time limit."""

import re
import time
from pathlib import Path

import pytest
from helpers.command_process import CommandProcess

NOTEBOOKS = Path(__file__).parents[1] / "docs" / "notebooks"
PAGES = sorted(NOTEBOOKS.glob("*.md"))
LIMIT = 90
"""Seconds with kernels to compile on a busy machine; with compiled kernels the slowest notebook takes 15 s."""


@pytest.fixture(scope="module")
def process():
    process = CommandProcess(NOTEBOOKS, MI_NTF_CACHE="memory")
    yield process
    process.close()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_notebook_runs(process, tmp_path, page):
    cells = re.findall(r"```\{code-cell\}[^\n]*\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    assert cells
    script = tmp_path / f"{page.stem}.py"
    script.write_text("\n".join(cells))
    start = time.perf_counter()
    code, printed = process.run("python", str(script))
    assert code == 0, printed
    assert time.perf_counter() - start < LIMIT


def test_every_notebook_is_in_the_contents():
    assert len(PAGES) >= 6
    index = (NOTEBOOKS.parent / "index.md").read_text(encoding="utf-8")
    assert all(f"notebooks/{page.stem}\n" in index for page in PAGES)
