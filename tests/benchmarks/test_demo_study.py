"""The study at the end of `make demo`, as a process of its own: its arguments, its files, and its failures."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import demo
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import kept

STUDY = """
import json, os, sys
from pathlib import Path
words = sys.argv[1:]
out = Path(words[words.index("-o") + 1])
assert os.environ["MI_NTF_CACHE"] == "off"
assert words[:2] == ["tradeoff", "scene.xml"], words
assert words[2:10] == ["-D", "light=env", "-D", "res=64", "-D", "spp=3", "--budget", "2m"], words
left = sorted(str(f.relative_to(out)) for f in out.rglob("*") if f.is_file())
result = json.loads(os.environ["RESULT"])
if result is None:
    sys.exit("mi-ntf: error: no light")
(out / "tradeoff.json").write_text(json.dumps({**result, "left": left}))
"""


def _study(tmp_path, monkeypatch, result):
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    monkeypatch.setenv("RESULT", json.dumps(result))
    command = [sys.executable, "-c", STUDY]
    return demo.study(command, Path("scene.xml"), tmp_path, "2m", 64, 3)


def test_a_study_takes_up_nothing_that_an_earlier_one_left(tmp_path, monkeypatch, capsys):
    for name in (kept.NAME, *demo.REPORT, "notes.txt"):
        (tmp_path / name).write_text("of yesterday")
    result = _study(tmp_path, monkeypatch, {"ways": []})
    assert result == {"ways": [], "left": ["notes.txt"]}
    assert f"{tmp_path}: the findings of an earlier study are removed" in capsys.readouterr().err
    assert _study(tmp_path, monkeypatch, {"ways": []})["left"] == ["notes.txt"]
    assert capsys.readouterr().err == ""  # nothing was dropped


def test_a_study_that_fails_or_measures_failures_alone_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "tradeoff.json").write_text("{}")
    with pytest.raises(MiNtfError, match=r"(?s)tradeoff scene\.xml.*failed with exit code 1; its messages are above"):
        _study(tmp_path, monkeypatch, None)
    with pytest.raises(MiNtfError, match="every way of the study failed, the first one since no light"):
        _study(tmp_path, monkeypatch, {"ways": [{"reason": "no light", "points": []},
                                                {"reason": "no time", "points": []}]})
