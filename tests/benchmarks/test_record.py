"""Files of results: header, history, spread; and the pages show what they hold."""

import json
import sys
import time

import pytest

from benchmarks import all as every
from benchmarks import record, tables
from mi_ntf.core.errors import MiNtfError


def test_a_former_result_becomes_history(tmp_path):
    start = time.perf_counter()
    path = record.write("demo", {"value": 1}, start, tmp_path)
    first = record.read("demo", tmp_path)
    assert first["values"] == {"value": 1}
    assert {"name", "commit", "date", "version", "machine", "command", "seconds"} == set(first["about"])
    assert first["about"]["commit"] and first["about"]["machine"]["cores"] > 0
    record.write("demo", {"value": 2}, start, tmp_path)
    assert record.read("demo", tmp_path)["values"] == {"value": 2}
    [former] = (tmp_path / record.HISTORY).iterdir()
    assert json.loads(former.read_text()) == first and path.parent == tmp_path
    with pytest.raises(MiNtfError, match=r"speed\.json does not exist; run `python -m benchmarks\.speed`"):
        record.read("speed", tmp_path)


def test_spread_and_ratios_of_rounds():
    assert record.spread([3, 1, 2, 9]) == {"median": 2.5, "min": 1, "max": 9, "repeats": 4}
    assert record.ratio([2.0, 6.0, 6.0], [1.0, 2.0, 3.0])["median"] == 2


def test_other_settings_need_another_folder(monkeypatch, tmp_path, capsys):
    more = ("--size", {"type": int, "default": 128})
    for words in (["--quick"], ["--size", "16"]):
        monkeypatch.setattr(sys, "argv", ["script", *words])
        with pytest.raises(SystemExit):
            record.options("Text.", more)
        assert "name another folder with --out" in capsys.readouterr().err
        monkeypatch.setattr(sys, "argv", ["script", *words, "--out", str(tmp_path)])
        assert record.options("Text.", more).out == tmp_path
    monkeypatch.setattr(sys, "argv", ["script"])
    assert record.options("Text.", more).out == record.RESULTS


def test_results_of_the_same_commit_are_current(monkeypatch, tmp_path):
    monkeypatch.setattr(record, "RESULTS", tmp_path)
    monkeypatch.setattr(record, "commit", lambda: "abc")
    assert not every.current("demo")
    record.write("demo", {}, time.perf_counter(), tmp_path)
    assert every.current("demo")
    for other in ("def", "abc+"):
        monkeypatch.setattr(record, "commit", lambda other=other: other)
        assert not every.current("demo")


ROW = {"light": "env", "visibility": "raymarch", "seconds": {"median": 19.34, "min": 19.0, "max": 20.0, "repeats": 3},
       "psnr": 31.94, "ssim": 0.95, "flip": 0.055, "relative_rmse": 0.1444, "relative_rmse_to_raymarch": 0.0}
PAGE = """Text.

<!-- table: demo -->
of yesterday
<!-- end -->

It takes <!-- value: demo.rows.0.seconds.median .1f -->1.0<!-- end --> s, with an error of
<!-- value: demo.rows.0.relative_rmse percent -->0 %<!-- end -->.
"""


def test_tables_and_values_come_from_the_results(monkeypatch, tmp_path):
    monkeypatch.setattr(record, "RESULTS", tmp_path)
    notes = []
    text = tables.rendered(PAGE, notes.append)
    assert "Not measured for this version: `python -m benchmarks.demo` does it." in text and "yesterday" not in text
    assert "-->1.0<!-- end --> s" in text and "no demo.json" in notes[0] and len(notes) == 3
    record.write("demo", {"rows": [ROW]}, time.perf_counter(), tmp_path)
    text = tables.rendered(PAGE)
    assert "| environment map | `raymarch` | 19.3 | 31.9 | 14.4 % | 0.0 % |\n" in text and "yesterday" not in text
    assert "`benchmarks/results/demo.json`: commit " in text
    assert "-->19.3<!-- end --> s" in text and "-->14.4 %<!-- end -->." in text
    assert tables.rendered(text) == text
    with pytest.raises(KeyError):
        tables.rendered(PAGE.replace("table: demo", "table: nothing"))


def test_pages_show_their_results():
    """`python -m benchmarks.tables` brings them up to date."""
    assert tables.different() == []
    marks = [name for page in tables.pages() for _, name, _, _ in tables.TABLE.findall(page.read_text("utf-8"))]
    assert set(marks) <= set(tables.TABLES)
