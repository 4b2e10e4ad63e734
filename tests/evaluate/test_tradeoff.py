"""`mi-ntf tradeoff` as a whole, on a tiny scene: its report, what is on the disk, resumption, failures."""

import csv
import json
import re
from html.parser import HTMLParser

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes
from helpers.variants import VARIANT

from mi_ntf import cli
from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.tradeoff import reading, references, report, search, state, study
from mi_ntf.evaluate.tradeoff.points import Point
from mi_ntf.evaluate.tradeoff.subject import Picture, Subject
from mi_ntf.jobs import Workers

SCENE = """<scene version="3.9.0">
    <default name="res" value="32"/>
    <default name="light" value="point"/>
    <integrator type="nrf"><integer name="samples" value="48"/><integer name="map_resolution" value="32"/>
        <boolean name="hide_emitters" value="true"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="28"/>
        <transform name="to_world"><lookat origin="1.6, 1.3, 5.3" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
        <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
            <rfilter type="box"/></film>
    </sensor>
    <emitter type="$light"><point name="position" x="3.4" y="3" z="2.5"/><rgb name="intensity" value="60, 50, 40"/>
    </emitter>
    <shape type="sphere">
        <point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
        <bsdf type="null"/>
        <medium type="nrf" name="interior"><string name="filename" value="ball.safetensors"/>
            <integer name="resolution" value="48"/></medium>
    </shape>
</scene>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene file with its field; the user's cache beside it."""
    folder = tmp_path_factory.mktemp("tradeoff")
    (folder / "scene.xml").write_text(SCENE)
    header, tensors = fields.blobs(scenes.CENTERS, scenes.RADII, similarity=scenes.SIMILARITY, log_density=3.0)
    field_file.save(folder / "ball.safetensors", header, tensors, np.float32)
    return folder


@pytest.fixture(autouse=True)
def few(monkeypatch, folder):
    """Two methods and small references; prices as built in."""
    mi.set_variant(VARIANT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    registry = {name: study.REGISTRY[name] for name in ("raymarch", "none")}
    monkeypatch.setattr(study, "REGISTRY", registry)
    monkeypatch.setattr(references, "LARGEST_PASS", 1 << 14)
    monkeypatch.setattr(references, "CROP", 8)
    for name, share in (("REFERENCE", 0.02), ("CHECK", 0.02)):
        monkeypatch.setattr(study, name, share)
    propose = search.Search.next

    def next_of_six(self, left):  # however busy the machine is
        return propose(self, left) if len(self.results) < 6 else None

    monkeypatch.setattr(search.Search, "next", next_of_six)


@pytest.fixture(scope="module")
def done(folder):
    """One study; tests of what it leaves share it."""
    return folder / "out"


class Outline(HTMLParser):
    """Tags that are open, those that load something, and ids."""

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.ids, self.texts = [], [], set(), []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href", "xlink:href", "action", "data")]
        self.ids |= {value for name, value in attrs if name == "id"}

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def outline(text: str) -> Outline:
    """The page, every tag of it closed."""
    found = Outline()
    found.feed(text)
    assert found.open == []
    return found


def test_the_command_from_end_to_end(folder, done, capsys):
    assert cli.main(["tradeoff", str(folder / "scene.xml"), "-o", str(done), "--budget", "3m"]) == 0
    printed = capsys.readouterr()
    assert "on the front" in printed.out and "reference:" in printed.err
    result = json.loads((done / "tradeoff.json").read_text())
    rows = reading.measured(result["points"])
    assert {"raymarch", "none"} <= {row["point"]["method"] for row in rows} and result["finished"]
    reference, check = result["references"]["reference"], result["references"]["check"]
    assert 0 < reference["noise"] < 0.1 and reference["spp"] >= 16 and "raymarch" in reference["about"]
    assert abs(check["difference"]) < 5 * check["sigma"] and "stock volpath" in check["verdict"]
    for row in rows:
        assert row["render"] > 0 and row["first"] >= row["compile"] and row["peak"] > 1e5 and row["repeats"] >= 1
        assert row["error"] == pytest.approx(np.hypot(row["noise"], row["bias"]))
    unlit = next(r for r in rows if r["point"]["method"] == "none" and r["point"]["spp"] == 4)
    marched = next(r for r in rows if r["point"]["method"] == "raymarch" and r["point"]["spp"] == 4)
    assert unlit["bias"] > 0.05 > marched["bias"]  # the balls' shadows
    with open(done / "tradeoff.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(t["error"]) for t in table if not t["reason"]] == [r["error"] for r in rows]
    assert table[0]["total"] and table[0]["spp"] == str(result["points"][0]["point"]["spp"])


def test_the_page_holds_all_it_shows(done):
    text = (done / "index.html").read_text()
    found = outline(text)
    assert all(value.startswith(("data:image/", "#")) for value in found.loads), found.loads
    assert not re.search(r"https?://|@import|url\((?!#)", re.sub(r"data:image/[^\"]*", "", text))
    result = json.loads((done / "tradeoff.json").read_text())
    points = json.loads(re.search(r'id="points">(.*?)</script>', text, re.S)[1])
    rows = reading.measured(result["points"])
    assert set(points) == {str(row["number"]) for row in rows}
    assert {f"p{row['number']}" for row in rows} <= found.ids  # the marks of the curve
    assert all(p["image"].startswith("data:image/png") and len(p["lines"]) >= 4 for p in points.values())
    words = " ".join(found.texts)
    assert all(part in words for part in (*result["reading"], result["machine"]["what"], "samples a pixel"))
    assert len(text) < 5e6


def test_a_study_that_was_killed_goes_on(folder, done, monkeypatch):
    """The last line is cut off; of what was found before nothing is measured again."""
    path = done / state.NAME
    lines = path.read_text().splitlines(keepends=True)
    points = [i for i, line in enumerate(lines) if '"kind": "point"' in line]
    kept = [json.loads(lines[i])["name"] for i in points[:-1]]
    path.write_text("".join(lines[: points[-1]]) + lines[points[-1]][:40])
    measured = []
    monkeypatch.setattr(study, "measure", lambda subject, point, *rest: measured.append(point) or 1 / 0)
    monkeypatch.setattr(references, "converge", lambda *a: 1 / 0)
    spent = sum(json.loads(line).get("spent", 0.0) for line in lines)
    result = study.tradeoff(folder / "scene.xml", done, {}, spent + 200, quiet=True)
    names = [row["name"] for row in result["points"]]
    assert set(kept) < set(names) and len(names) == len(set(names))
    assert not {state.name_of(p.as_dict()) for p in measured} & set(kept)
    failed = [row for row in result["points"] if row["reason"]]
    assert failed and all("ZeroDivisionError" in row["reason"] for row in failed)
    assert "ZeroDivisionError" in (done / "index.html").read_text()


def test_another_scene_begins_anew(folder, done, monkeypatch, capsys):
    monkeypatch.setattr(references, "choose_picture", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        study.tradeoff(folder / "scene.xml", done, {"res": "24"}, 5.0)
    assert "begun anew, what lay in" in capsys.readouterr().err
    assert len((done / state.NAME).read_text().splitlines()) == 1


def test_a_point_that_fails_is_a_row_and_an_interruption_leaves_a_report(folder, tmp_path, monkeypatch):
    """`raymarch` is interrupted, `none` cannot be rendered before."""
    def measure(subject, point, *rest):
        if point.method == "none":
            raise MiNtfError("no such light")
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "measure", measure)
    image = np.ones((32, 32, 3), np.float32)
    monkeypatch.setattr(references, "converge", lambda *a: references.Reference(image, 0.0, 4, 4, 1.0, "ones"))
    monkeypatch.setattr(references, "choose_picture", lambda *a: (Picture(), "whole"))
    monkeypatch.setattr(references, "hold_against_stock", lambda *a: {"verdict": "not held", "reason": "no time"})
    with pytest.raises(KeyboardInterrupt):
        study.tradeoff(folder / "scene.xml", tmp_path, {}, 50.0, quiet=True)
    result = json.loads((tmp_path / "tradeoff.json").read_text())
    assert [(r["label"], r["reason"]) for r in result["points"]] == [("none, 4 spp", "no such light")]
    page = outline((tmp_path / "index.html").read_text())
    assert "failed: no such light" in page.texts and any("interrupted" in text for text in page.texts)


def test_what_ends_the_process_twice_is_not_begun_again(tmp_path):
    found = state.State(tmp_path, {"a": 1})
    for _ in range(2):
        found.add("begun", name="x")
    assert state.State(tmp_path, {"a": 1}).attempts("x") == 2
    found.add("interrupted", name="x")
    assert state.State(tmp_path, {"a": 1}).attempts("x") == 1
    assert state.State(tmp_path, {"a": 2}).fresh == "a"


def test_a_scenes_properties_are_changed_whatever_its_xml_says(folder):
    subject = Subject(folder / "scene.xml", {"res": "40"})
    assert subject.size == (40, 40) and subject.base == Point("auto", 4, 2, 48, 0, 512, 32)
    scene = subject.load(Point("raymarch", 1, representation="network"), Picture(2, (3, 4, 8, 6)))
    assert scene.shapes()[0].interior_medium().representation == "network"
    film = scene.sensors()[0].film()
    assert (tuple(film.size()), tuple(film.crop_size()), tuple(film.crop_offset())) == ((20, 20), (8, 6), (3, 4))
    nrf = subject.integrator(Point("transmittance_map", 1, 3, 96, map_resolution=64), 9.0)
    assert (nrf.visibility, nrf.samples, nrf.map_resolution, nrf.max_depth) == ("transmittance_map", 96, 64, 3)
    assert nrf.hide_emitters and nrf.timeout == 9


def test_the_mesh_is_found_and_must_fit(folder, tmp_path):
    subject = Subject(folder / "scene.xml", {})
    assert references.find_mesh(subject) is None
    path = tmp_path / "mesh.exr"
    mi.Bitmap(np.kron(np.eye(32), np.ones((2, 2)))[..., None].astype(np.float32) * np.ones(3, np.float32)).write(
        str(path))
    found = references.mesh(subject, path, Picture(), (32, 32, 3), 1.0)
    np.testing.assert_allclose(found.image, np.eye(32)[..., None] * np.ones(3))
    with pytest.raises(MiNtfError, match="has 64×64 pixels, the study's pictures 48×48"):
        references.mesh(subject, path, Picture(), (48, 48, 3), 1.0)
    with pytest.raises(MiNtfError, match=r"nowhere\.exr does not exist"):
        study.tradeoff(folder / "scene.xml", tmp_path, {}, 5.0, tmp_path / "nowhere.exr")


def test_the_crop_is_where_the_light_is():
    image = np.zeros((40, 30, 3))
    image[20:25, 10:14] = 1
    x, y, width, height = references.crop_of(image, 8)
    assert (width, height) == (8, 8) and x <= 10 and x + 8 >= 14 and y <= 20 and y + 8 >= 25


@pytest.mark.parametrize(("p", "sigma", "said"), [
    (0.5, 0.01, "no difference is found"), (0.03, 0.01, "a difference is likely"), (1e-4, 0.01, "is off by about"),
    (1e-4, 0.05, "too noisy to tell differences below 10%")])
def test_what_the_comparison_with_volpath_says(p, sigma, said):
    found = {"difference": 0.02, "sigma": sigma, "z": 2.0, "p": p, "crop": [0, 0, 16, 16], "stock_spp": 64}
    assert said in references.verdict(found) and "+2.00%" in references.verdict(found)


@pytest.mark.parametrize(("text", "found"), [("90s", 90), ("5m", 300), ("1h", 3600), ("1.5m", 90)])
def test_budgets(text, found):
    assert study.seconds(text) == found


@pytest.mark.parametrize("text", ["5", "m", "-3m", "0s", "5 minutes"])
def test_budgets_that_are_none_are_refused(text, folder, capsys):
    with pytest.raises(MiNtfError, match="expected a time of a second or more such as 90s, 5m or 1h"):
        study.seconds(text)
    assert cli.main(["tradeoff", str(folder / "scene.xml"), f"--budget={text}"]) == 2


def row(number, seconds, noise, bias, method="raymarch", **more):
    return {"number": number, "label": f"{method} {number}", "build": 0.0, "render": seconds, "noise": noise,
            "bias": bias, "uncertainty": 1e-8, "error": float(np.hypot(noise, bias)), "reason": "",
            "point": Point(method, 1).as_dict(), "load": 0.5, **more}


def test_the_curve_is_read():
    rows = [row(0, 8.0, 0.008, 0.0), row(0, 1.0, 0.15, 0.0), row(0, 2.0, 0.01, 0.016), row(0, 3.0, 0.3, 0.0),
            row(0, 100.0, 0.3, 0.0, "volpath"), {**row(0, 0, 0, 0), "reason": "why not"}]
    reading.mark_front(rows)
    assert [r["number"] for r in rows if r["front"]] == [1, 2, 4] and rows[-1]["reason"]
    text = reading.reading(rows)
    assert "below 10% no. 2" in text[0] and "below 2% no. 2" in text[0] and "below 1% no. 4" in text[0]
    assert "bends at no. 2" in text[1]
    assert "volpath errs by 30% after 100 s" in text[2] and "100 times sooner" in text[2]
    assert "no. 2 err by bias" in text[3]
    assert "up to 9 jobs on 2 cores" in reading.busy([row(1, 1, 1, 1, load=9.0)], 2) and not reading.busy(rows, 2)


def test_thumbnails_are_small_and_show_the_difference():
    reference = np.full((300, 200, 3), 0.5)
    thumbs = report._Thumbnails(reference)
    assert thumbs.picture(reference).shape == (100, 66, 3)
    np.testing.assert_allclose(thumbs.picture(reference), report.BRIGHT)
    assert thumbs.difference(reference).max() < 10 < 200 < thumbs.difference(2 * reference).max()


def test_workers_render_the_passes_of_the_reference(folder, tmp_path):
    subject, picture = Subject(folder / "scene.xml", {"res": "16"}), Picture()
    here = references.converge(subject, picture, 0.0, lambda text: None)
    shared = references.converge(subject, picture, 0.0, lambda text: None, Workers("local", 2), tmp_path)
    assert (shared.passes, shared.spp) == (here.passes, here.spp) == (4, 4)
    assert abs(shared.image.mean() / here.image.mean() - 1) < 0.05 and shared.noise < 0.3
    task = references.Pass(subject.path.absolute(), (("res", "16"),), VARIANT, picture, 2, references.FIRST_SEED + 7)
    own = references.Renderer(subject, references.way(subject), picture)
    np.testing.assert_array_equal(references.one_pass(task), own(2, references.FIRST_SEED + 7)[0])


def test_points_are_measured_here_whoever_renders_the_reference(folder, tmp_path, monkeypatch):
    chosen = []
    image = np.ones((32, 32, 3), np.float32)
    monkeypatch.setattr(references, "converge",
                        lambda *a: chosen.append(a[4]) or references.Reference(image, 0.0, 4, 4, 1.0, "ones"))
    monkeypatch.setattr(study.Study, "_search", lambda self: search.Search(self.subject.base, [], self.subject.limits,
                                                                         lambda point: (0.0, 0.0), 1.0))
    monkeypatch.setattr(references, "hold_against_stock", lambda *a: {"verdict": "none"})
    study.tradeoff(folder / "scene.xml", tmp_path, {"res": "32"}, 5.0, quiet=True, workers=Workers("local", 2))
    assert chosen == [Workers("local", 2)]
