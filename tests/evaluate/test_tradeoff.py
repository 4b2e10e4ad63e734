"""`mi-ntf tradeoff` as a whole, on small scenes: its report, what is on the disk, resumption, Ctrl-C, failures."""

import copy
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from evaluate import small_study
from helpers.variants import VARIANT

from mi_ntf import cli
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import kept
from mi_ntf.evaluate.tradeoff import measure, report, study, ways
from mi_ntf.infer.visibility import REGISTRY

ALL = [*REGISTRY, ways.STOCK]
"""Methods that the scene ``many.xml`` is rendered by."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return small_study.write(tmp_path_factory.mktemp("tradeoff"))


@pytest.fixture(autouse=True)
def variant(monkeypatch, folder):
    mi.set_variant(VARIANT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))


@pytest.fixture(scope="module")
def done(folder):
    """The study of two fields on a floor under three lights; tests of what it leaves share it."""
    mi.set_variant(VARIANT)
    study.tradeoff(folder / "many.xml", folder / "out", {}, 4.0)
    return folder / "out"


@pytest.fixture
def counted(monkeypatch):
    """Renders so far: the integrators' methods."""
    calls, once = [], measure.once

    def count(scene, integrator, *rest):
        calls.append(integrator.context.settings.visibility if hasattr(integrator, "context") else "stock")
        return once(scene, integrator, *rest)

    monkeypatch.setattr(measure, "once", count)
    return calls


class Outline(HTMLParser):
    """Tags that are open, those that load something, and texts."""

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.texts = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href", "xlink:href", "action", "data")]

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.texts.append(data)


def outline(text: str) -> Outline:
    """The page, every tag of it closed."""
    found = Outline()
    found.feed(text)
    assert found.open == []
    return found


def result_of(out):
    return json.loads((out / "tradeoff.json").read_text())


def test_every_method_has_a_curve_on_two_fields_a_floor_and_three_lights(done):
    result = result_of(done)
    rows = {row["method"]: row for row in result["ways"] if not row["finer"]}
    assert sorted(rows) == sorted(ALL) and result["finished"]
    for row in rows.values():
        assert row["points"] and not row["reason"], row
        seconds, samples = ([p[name] for p in row["points"]] for name in ("seconds", "samples"))
        assert seconds == sorted(seconds) and samples == sorted(set(samples)) and seconds[0] > 0
    assert sum(len(row["points"]) > 1 for row in rows.values()) >= 6
    end = rows["none"]["points"][-1]
    assert end["bias"] - 3 * end["bias_uncertainty"] > 0.05  # the shadows on the floor
    assert not any(p.get("front") for p in rows["none"]["points"])
    assert any(p["front"] for row in rows.values() for p in row["points"] if row["method"] != "none")


def test_the_table_for_programs_has_a_line_for_each_point(done):
    rows = result_of(done)["ways"]
    with open(done / "tradeoff.csv", newline="") as file:
        table = list(csv.DictReader(file))
    points = [(row["title"], point["error"]) for row in rows for point in row["points"]]
    assert [(line["way"], float(line["error"])) for line in table] == points
    assert table[0]["noise"] == "" and table[1]["samples"] == "2"


def test_the_page_is_whole_and_offline_and_in_plain_words(folder, done):
    text = (done / "index.html").read_text()
    found = outline(text)
    assert all(value.startswith(("data:image/", "#")) for value in found.loads), found.loads
    assert not re.search(r"https?://|@import|url\((?!#)", re.sub(r"data:image/[^\"]*", "", text))
    words = " ".join(found.texts)
    assert "`" not in words and not any("volpath" in t and "shadows" in t for t in found.texts)
    assert f"<h1>What accuracy costs: {folder.name}/many.xml</h1>" in text and f"<h1>{folder}" not in text
    for row in result_of(done)["ways"]:
        assert row["title"] in words and f"How to render by {row['title']}" in words and row["xml"].strip() in words
    assert words.count('<integrator type="nrf">') == len(REGISTRY) and "stock volpath, after" in words
    assert text.count('tabindex="0"') >= 2 and 'min-width: 760px' in text  # figure and table scroll by themselves
    assert text.count('class="copy"') >= len(ALL) and "execCommand" in text and len(text) < 5e6


def test_a_finished_study_is_not_rendered_again(folder, done, counted, capsys):
    before = result_of(done)
    after = study.tradeoff(folder / "many.xml", done, {}, 4.0)
    assert after["ways"] == before["ways"] and counted == []
    assert "goes on: " in capsys.readouterr().err


def test_an_interrupted_study_renders_what_is_missing(folder, done, counted, tmp_path):
    """The file was cut off within the fifth way."""
    out = tmp_path / "out"
    shutil.copytree(done, out)
    lines = (out / kept.NAME).read_text().splitlines(keepends=True)
    at = [i for i, line in enumerate(lines) if line.startswith('{"name": "way ')]
    names = [json.loads(lines[i])["values"]["method"] for i in at]
    (out / kept.NAME).write_text("".join(lines[: at[4]]) + lines[at[4]][:50])
    result = study.tradeoff(folder / "many.xml", out, {}, 4.0)
    assert [row["method"] for row in result["ways"]] == names and result["finished"]
    again = {*counted} - {"raymarch", "stock"}  # raymarch is the small render that shows how steady the machine is
    assert again == {*names[4:]} - {"raymarch", ways.STOCK}
    errors = [[[p["error"] for p in row["points"]] for row in found["ways"][:4]] for found in (result, result_of(done))]
    assert errors[0] == errors[1]


def test_another_scene_or_budget_begins_anew(folder, done, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    shutil.copytree(done, out)
    monkeypatch.setattr(study.Study, "run", lambda self: None)
    monkeypatch.setattr(study.Study, "result", lambda self: {})
    study.tradeoff(folder / "many.xml", out, {}, 4.0)
    assert "begins anew" not in capsys.readouterr().err
    study.tradeoff(folder / "many.xml", out, {}, 5.0)
    assert "begins anew, since" in (said := capsys.readouterr().err) and "of another budget" in said
    study.tradeoff(folder / "many.xml", out, {"res": "20"}, 5.0)
    assert "of another scene" in capsys.readouterr().err
    assert list(kept.State(out, {"budget": 1}).lines) == ["key"]


@pytest.mark.parametrize("lost", [False, True])
def test_what_begins_anew_renders_its_own_reference(folder, done, tmp_path, lost):
    """Pictures of the earlier study lie there, perhaps without the file that says what they are of."""
    out = tmp_path / "out"
    shutil.copytree(done, out)
    if lost:
        (out / kept.NAME).unlink()
    result = study.tradeoff(folder / "one.xml", out, {"res": "16"}, 1.0)
    assert result["finished"] and result["size"] == (16, 16)
    with np.load(out / kept.PICTURES / "reference.npz") as file:
        assert file["image"].shape == (16, 16, 3)


def interrupting(monkeypatch, method: str):
    """Ctrl-C in the first render by a method, as Mitsuba hands it on."""
    once, calls = measure.once, []

    def interrupted(*arguments):
        nrf = hasattr(arguments[1], "context")
        calls.append(arguments[1].context.settings.visibility if nrf else ways.STOCK)
        if [method] == calls[-1:] and calls.count(method) == 1:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(9)
            except KeyboardInterrupt as error:
                raise RuntimeError("drjit.custom(<mitsuba.python.util._RenderOp>): error (see above)") from error
        return once(*arguments)

    monkeypatch.setattr(measure, "once", interrupted)


def test_an_interruption_leaves_the_report_and_130(folder, tmp_path, monkeypatch, capsys):
    interrupting(monkeypatch, "transmittance_map")
    before = signal.getsignal(signal.SIGINT)
    words = ["tradeoff", str(folder / "one.xml"), "-o", str(tmp_path), "--budget", "3s", "-D", "res=16"]
    assert cli.main(words) == 130
    said = capsys.readouterr().err
    ended = re.search(r"mi-ntf: stopped; (\d+) ways are finished, and the same command goes on$", said, re.M)
    assert ended and signal.getsignal(signal.SIGINT) is before
    result = result_of(tmp_path)
    assert len(result["ways"]) == int(ended[1]) > 0 and not result["finished"]
    assert not any(row["reason"] for row in result["ways"])
    assert "KeyboardInterrupt" not in (tmp_path / kept.NAME).read_text()
    page = outline((tmp_path / "index.html").read_text())
    assert any("The study was interrupted" in text for text in page.texts)
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    assert cli.main(words) == 0
    after = result_of(tmp_path)
    errors = [[[p["error"] for p in row["points"]] for row in found["ways"]] for found in (result, after)]
    assert errors[1][: len(errors[0])] == errors[0] and after["finished"]
    assert f"goes on: {ended[1]} ways are finished" in capsys.readouterr().err


def test_an_interruption_before_the_reference_leaves_no_report(folder, tmp_path, monkeypatch, capsys):
    interrupting(monkeypatch, "raymarch")
    assert cli.main(["tradeoff", str(folder / "one.xml"), "-o", str(tmp_path), "--budget", "2s"]) == 130
    assert "mi-ntf: stopped; 0 ways are finished" in capsys.readouterr().err
    assert not (tmp_path / "index.html").exists()


def test_a_signal_to_the_program_ends_it(folder, tmp_path):
    """Real Mitsuba, which hands the interruption on in its own way."""
    words = ["tradeoff", str(folder / "many.xml"), "-o", str(tmp_path), "--budget", "60s"]
    with subprocess.Popen([sys.executable, "-m", "mi_ntf", *words], stderr=subprocess.PIPE, text=True) as program:
        said = []
        for line in program.stderr:
            said.append(line)
            if " s  raymarch: error" in line:
                time.sleep(1)
                program.send_signal(signal.SIGINT)
        assert program.wait(60) == 130
    assert re.fullmatch(r"mi-ntf: stopped; \d+ ways are finished, and the same command goes on\n", said[-1]), said
    rows = result_of(tmp_path)["ways"]
    assert rows[0]["method"] == "raymarch" and not any(row["reason"] for row in rows)


def test_a_way_that_fails_is_a_row_that_says_why(folder, tmp_path, monkeypatch, capsys):
    once = measure.once

    def failing(scene, integrator, *rest):
        if hasattr(integrator, "context") and integrator.context.settings.visibility == "transmittance_map":
            raise MiNtfError("no room for maps")
        return once(scene, integrator, *rest)

    monkeypatch.setattr(measure, "once", failing)
    study.tradeoff(folder / "one.xml", tmp_path, {"res": "16"}, 1.0)
    rows = {row["way"]: row for row in result_of(tmp_path)["ways"]}
    assert rows["transmittance_map"]["reason"] == "no room for maps" and rows["raymarch"]["points"]
    assert "failed: no room for maps" in outline((tmp_path / "index.html").read_text()).texts
    monkeypatch.setenv("COLUMNS", "80")
    report.print_table(result_of(tmp_path), Path("study"))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and [line.partition(":")[0] for line in lines[-3:]] == ["page", "verdict", "next"]


@pytest.mark.parametrize(("end", "sentence"), [
    (0.04, "slow is the fastest to an error of 5%, after 3.5 s"),
    (0.08, "quick is the fastest to an error of 10%, after "),
    (0.2, "no way reached an error of 10%; give a longer --budget")])
def test_the_verdict_names_the_fastest_way_to_the_least_error(end, sentence):
    ways = [row([1.0, 4.0], [0.5, end], method="slow"), row([0.5, 2.0], [0.5, max(end, 0.07)], method="quick")]
    assert report.verdict({"ways": ways}).startswith(sentence)


def test_what_is_built_is_built_anew_for_each_way(folder, tmp_path, monkeypatch):
    """Neither maps in memory nor those on the disk are taken over, though the user's cache is on."""
    from mi_ntf.render.maps import building

    built, build = [], building.build
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    monkeypatch.setattr(building, "build", lambda name, *rest: built.append(name) or build(name, *rest))
    made = []
    cached = building.map_cache.cached
    monkeypatch.setattr(building.map_cache, "cached",
                        lambda name, make, *rest, **options: cached(
                            name, lambda *v: made.append(name) or make(*v), *rest, **options))
    for _ in range(2):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        study.tradeoff(folder / "one.xml", tmp_path / "out", {"res": "16"}, 1.0)
    maps = {name for name in made}
    assert all(made.count(name) >= 2 for name in maps) and len(maps) >= 2
    assert not list((folder / "cache").rglob("maps/*"))


def fake_study(folder, tmp_path, monkeypatch, budget):
    """Shares of the ways of a study, each of which uses its own, by their names; and what was left out."""
    shares = {}

    def use(self, way, shrink, share):
        shares[way.name] = share
        self._start -= share

    monkeypatch.setattr(study.Study, "_prepare", lambda self: (1, lambda *a: (None, 1.0)))
    monkeypatch.setattr(study.Study, "_probe", lambda self, render: None)
    monkeypatch.setattr(study.Study, "_try", use)
    monkeypatch.setattr(study.Study, "result", lambda self: self.state.lines["end"])
    return shares, study.tradeoff(folder / "one.xml", tmp_path, {}, budget)["left_out"]


def test_the_budget_is_shared_evenly(folder, tmp_path, monkeypatch):
    shares, left_out = fake_study(folder, tmp_path / "a", monkeypatch, 40.0)
    serves = len(REGISTRY) - 1 + 1  # the field has no visibility MLP; and volpath
    assert len(shares) == serves and left_out
    np.testing.assert_allclose(list(shares.values()), 40 / serves, rtol=0.02)
    shares, left_out = fake_study(folder, tmp_path / "b", monkeypatch, 1000.0)
    assert not left_out and len(shares) > serves and min(shares.values()) >= measure.TIMES[-1]
    np.testing.assert_allclose(list(shares.values()), 1000 / len(shares), rtol=0.02)
    assert next(iter(shares)) == "raymarch" and list(shares)[serves:] == [n for n in shares if "-" in n]


def row(seconds, errors, uncertainty=0.0, method="raymarch", **more):
    points = [{"seconds": s, "samples": 2**i, "error": e, "error_uncertainty": uncertainty, "noise": None, "bias": None,
               "front": True} for i, (s, e) in enumerate(zip(seconds, errors, strict=True))]
    return {"way": method, "method": method, "title": method, "finer": False, "points": points, "reason": "",
            "note": "", "xml": "<integrator/>", "command": "", "shift": [0.01, 0.001], "peak": 1, **more}


def test_seconds_to_an_error_are_read_with_their_range():
    cells = report.cells(row([1.0, 4.0, 16.0], [0.2, 0.1, 0.05], 0.005))
    assert cells[:3] == ["raymarch", "4 s (3.6 s to 4.4 s)", "16 s (13 s to not reached)"]
    assert cells[3:5] == ["not reached", "not reached"]
    assert report.cells(row([0.5, 2.0], [0.08, 0.04]))[1] == "at most 0.5 s"
    assert cells[5:9] == ["5.0% ± 0.5%", "16 s", "4", "not known"]
    assert report.cells(row([1.0], [0.2], method="none"))[0] == "none (a bound)"
    assert report.cells(row([], [], reason="no light")) == ["raymarch", "failed: no light"]


@pytest.mark.parametrize(("spread", "warned"), [(0.3, True), (0.05, False), (None, False)])
def test_an_unsteady_machine_is_said(spread, warned):
    result = {"machine": {"spread": spread, "probe_seconds": [0.2, 0.4]}}
    assert ("the same small render took 0.2 s to 0.4 s" in report.unsteady(result)) == warned


@pytest.mark.parametrize(("shift", "said"), [
    ((0.003, 0.002), ", no difference."), ((0.03, 0.002), ", a difference."), ((-0.005, 0.002), "perhaps a"),
    ((0.03, 0.05), "too noisy to show differences below 10%")])
def test_what_stock_volpath_says_of_the_reference(shift, said):
    assert said in report.check({"ways": [row([1.0], [0.3], method="volpath", shift=shift)]})
    assert report.check({"ways": []}) == "The reference was not compared with stock volpath."


def test_a_budget_that_is_none_is_bad_usage(folder):
    assert cli.main(["tradeoff", str(folder / "one.xml"), "--budget=soon"]) == 2


def test_the_bound_is_no_choice(folder, tmp_path):
    """The bound of no visibility is left out of the front, though nothing is faster or more accurate."""
    begun = study.Study(ways.Subject(folder / "one.xml", {}), tmp_path, 9.0, None)
    begun.state.add("picture", {"shrink": 1})
    begun.state.add("reference", {})
    for method, seconds in (("none", 0.1), ("raymarch", 1.0), ("volpath", 2.0)):
        begun.state.add(f"way {method}", row([seconds], [seconds / 9], method=method))
        del begun.state.lines[f"way {method}"]["points"][0]["front"]
    marks = {row["method"]: row["points"][0].get("front") for row in begun.result()["ways"]}
    assert marks == {"none": None, "raymarch": True, "volpath": False}


def test_pictures_of_an_earlier_study_are_of_no_failed_way(tmp_path, done):
    result = copy.deepcopy(result_of(done))
    result["ways"][0] |= {"points": [], "reason": "it failed"}
    stale = {row["way"]: {"1": np.zeros((2, 2, 3), np.float32)} for row in result["ways"]}
    for row in result["ways"]:
        row["points"] = row["points"] and [{**point, "seconds": 0.9} for point in row["points"]]
    report.write(result, np.ones((2, 2, 3), np.float32), stale, tmp_path)
    titles = [row["title"] for row in result["ways"] if row["points"]]
    text = (tmp_path / "index.html").read_text()
    assert titles and all(f"{title}: error" in text for title in titles)
    assert f"{result['ways'][0]['title']}: error" not in text
