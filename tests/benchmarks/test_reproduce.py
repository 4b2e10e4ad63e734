"""`mi-ntf reproduce`: a folder that outlives kills, jobs that fail alone, and all of it on a tiny field."""

import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from helpers.variants import VARIANT

from benchmarks import reproduce as package
from benchmarks import transmittance
from benchmarks.bench_measure import QUICK as BENCH
from benchmarks.reproduce import compared, lights, networks, state
from benchmarks.reproduce.jobs import Job
from mi_ntf import cli
from mi_ntf.core import field_file
from mi_ntf.core.architecture import Encoding, Network
from mi_ntf.core.errors import MiNtfError
from mi_ntf.jobs import Workers, running

TINY = replace(compared.QUICK, pixels=24, points=2, skies=1, spp=(4, 1), reference_spp=16, cells=6, map_resolution=24,
               views=4, photograph=16, steps=8, stages=(0.25, 1), study=(16, 1, 2), build=(1, 2), bench=BENCH)
MESH = """<scene version="3.9.0"><default name="res" value="16"/>
<integrator type="path"/>
<sensor type="perspective"><float name="fov" value="28"/>
<transform name="to_world"><lookat origin="1.6, 1.3, 5.3" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
<string name="pixel_format" value="rgba"/><rfilter type="box"/></film></sensor>
SHAPES</scene>"""
SHAPE = ('<shape type="sphere"><point name="center" x="{}" y="{}" z="{}"/><float name="radius" value="{}"/>'
         '<bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf></shape>')


@pytest.fixture
def scene(tmp_path):
    """A folder as those of scenes/: three balls, and a field of them by hand."""
    folder = tmp_path / "balls"
    field = scenes.write_blobs(folder)
    shutil.move(field, folder / "field.safetensors")
    centre, radius = np.array(scenes.SIMILARITY.center), scenes.SIMILARITY.radius
    shapes = [SHAPE.format(*(centre + radius * np.array(c)), radius * r)
              for c, r in zip(scenes.CENTERS, scenes.RADII, strict=True)]
    (folder / "mesh.xml").write_text(MESH.replace("SHAPES", "\n".join(shapes)))
    return folder


def rows(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "jobs.jsonl").read_text().splitlines()]


def job(name: str, run=dict, **rest) -> Job:
    return Job(name, "same", run, **rest)


def test_a_run_goes_on_after_a_kill_within_a_line(tmp_path):
    with state.State(tmp_path) as first:
        package._work([job("a", lambda: {"value": 1}), job("b", lambda: {"value": 2})], first)
    whole = (tmp_path / "jobs.jsonl").read_bytes()
    (tmp_path / "jobs.jsonl").write_bytes(whole[:-9])  # the kill came while b's line was being written
    calls = []
    with state.State(tmp_path) as second:
        assert set(second.rows) == {"a"} and second.rows["a"]["value"] == 1
        package._work([job(n, lambda n=n: calls.append(n) or {"value": 3}) for n in "abc"], second)
    assert calls == ["b", "c"]
    assert [(r["job"], r["value"]) for r in rows(tmp_path)] == [("a", 1), ("b", 3), ("c", 3)]


def test_other_settings_and_lost_files_are_done_again(tmp_path):
    made = tmp_path / "made.exr"
    made.touch()
    with state.State(tmp_path) as held:
        held.add({"job": "a", "about": "same"})
        assert held.done("a", "same") and not held.done("a", "other") and not held.done("b", "same")
        assert package._done(job("a", makes=made), held)
        made.unlink()
        assert not package._done(job("a", makes=made), held)


def test_a_failing_job_is_a_row_and_others_go_on(tmp_path, capsys):
    def fail():
        raise MiNtfError("no light here; give one")

    work = [job("bad", fail), job("waits", needs=("bad",)), job("later", needs=("waits",)), job("good")]
    with state.State(tmp_path) as held:
        assert package._work(work, held) == {"bad", "waits", "later"}
        assert not held.done("bad", "same") and held.done("good", "same")
    assert [(r["job"], r.get("error")) for r in rows(tmp_path)] == [("bad", "no light here; give one"), ("good", None)]
    assert "bad: no light here; give one" in capsys.readouterr().err
    mended = [job("bad"), job("waits", needs=("bad",)), job("good", partial(pytest.fail, "done before"))]
    with state.State(tmp_path) as held:
        assert package._work(mended, held) == set()
        assert "error" not in held.rows["bad"]


def test_folders_that_are_in_use_or_damaged_are_refused(tmp_path):
    with state.State(tmp_path), pytest.raises(MiNtfError, match="another run is at work"):
        state.State(tmp_path)
    (tmp_path / "jobs.jsonl").write_text('{"job": "a", "about": "x"}\nnonsense\n')
    with pytest.raises(MiNtfError, match=r"jobs\.jsonl, line 2, is no row of a run; delete that line"):
        state.State(tmp_path)


def ray_field(source: Path, out: Path) -> None:
    """The field `source` with a small ray network of end points and a network of NeRV's, as trainings make them."""
    header, tensors = field_file.load(source)
    own = replace(header.architecture, transmittance=Network(Encoding("frequency", octaves=2), (8,)),
                  visibility=Network(Encoding("frequency", octaves=1), (8,)))
    rng = np.random.default_rng(0)
    values = {k: tensors[k] if k in tensors and tensors[k].shape == s else 0.3 * rng.normal(size=s)
              for k, s in own.skeleton().items()}
    field_file.save(out, replace(header, architecture=own), values, np.float32)


@pytest.fixture
def trained(monkeypatch):
    """Trainings without their minutes; holds their command lines."""
    seen = []

    def run(*words):
        words = [str(w) for w in words]
        seen.append(words)
        if words[0] == "capture":
            Path(words[2]).mkdir()
        elif words[0] == "train":
            ray_field(Path(words[words.index("--field") + 1]), Path(words[words.index("-o") + 1]))

    monkeypatch.setattr(networks, "_run", run)
    monkeypatch.setattr(transmittance, "query_time", lambda medium: 1.0)
    return seen


def test_all_of_it_on_a_tiny_field(scene, trained, tmp_path, monkeypatch):
    mi.set_variant(VARIANT)
    monkeypatch.setattr(package, "QUICK", TINY)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    out, names = tmp_path / "out", ["NRF", "TM", "AG", "NeRV"]
    wanted = {"quick": True, "scenes": [str(scene)], "tables": ["table2", "curves", "ablation"], "methods": names}
    found = package.reproduce(out, **wanted)
    assert (found["done"], found["failed"]) == (found["jobs"], {})
    assert [w[0] for w in trained] == ["capture", "train", "train"]  # AG, and the curves' early stage
    assert "--visibility-mlp" in trained[1] and "--no-augmentation" not in trained[1]
    pictures = [r for r in rows(out) if "metrics" in r]
    assert len(pictures) == (2 + 1) * 4 and all(r["metrics"]["ms_ssim"] is None for r in pictures)
    by_method = {n: np.mean([r["metrics"]["rmse"] for r in pictures if r["method"] == n]) for n in names}
    assert 0 < by_method["NRF"] < 0.14 and by_method["AG"] > 1.05 * by_method["NRF"]  # random weights: no shadows
    assert by_method["NRF"] < by_method["TM"] < 1.3 * by_method["NRF"]  # 24² texels of a network by hand
    drops = found["drops"]["point"]["AG"]["rmse"]
    assert drops["images"] == 2 and drops["ours"] > 0.05 and drops["paper"] == pytest.approx(0.4448, abs=1e-3)
    html = (out / "report.html").read_text()
    assert not re.findall(r"https?:|src=\"(?!data:)|<script|<link|@import", html)
    assert "Means of 1 to 2 pictures of 24² pixels" in html and "failed" not in html and "svg+xml" in html
    assert r"\begin{table}" in (out / "tables.tex").read_text()
    curves = next(r for r in rows(out) if r["job"] == "curves")["curves"]
    assert list(curves) == ["marched", "shipped network", "2 steps", "8 steps", "NeRV"]
    assert curves["marched"][-1] == 1 and curves["marched"][0] < 0.01 and (np.diff(curves["marched"]) > -1e-4).all()
    monkeypatch.setattr(package, "do", partial(pytest.fail, "it was done before"))
    assert package.reproduce(out, **wanted)["done"] == found["jobs"]
    reference = out / "references" / "balls" / "point-001.exr"
    reference.unlink()  # that one alone is made again
    again = []
    monkeypatch.setattr(package, "do", lambda job: again.append(job.name) or {"job": job.name, "about": job.about})
    package.reproduce(out, **wanted)
    assert again == ["reference/balls/point-001"]


@pytest.mark.slow
def test_several_workers_give_the_rows_of_one(scene, tmp_path, monkeypatch):
    mi.set_variant(VARIANT)
    monkeypatch.setattr(package, "QUICK", TINY)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    wanted = {"quick": True, "scenes": [str(scene)], "tables": ["table2"], "methods": ["TM"]}
    package.reproduce(tmp_path / "one", **wanted)
    found = package.reproduce(Path("two"), **wanted, workers=Workers("local", 2))  # a relative folder
    assert (found["done"], found["failed"], found["waiting"]) == (found["jobs"], {}, [])
    one, two = ({r["job"]: r for r in rows(tmp_path / folder)} for folder in ("one", "two"))
    assert one.keys() == two.keys() and sum("metrics" in r for r in one.values()) == 3
    for name, row in one.items():
        assert row.get("metrics") == two[name].get("metrics") and row.get("file") == two[name].get("file")
        assert "shared" in two[name] and "shared" not in row
    for path in (tmp_path / "one").rglob("*.exr"):
        assert path.read_bytes() == (tmp_path / "two" / path.relative_to(tmp_path / "one")).read_bytes()
    assert "3 of them were made by several workers" in (tmp_path / "two" / "report.html").read_text()


def test_what_fails_at_several_workers_leaves_the_rest(scene, tmp_path, monkeypatch):
    mi.set_variant(VARIANT)
    monkeypatch.setattr(package, "QUICK", TINY)
    monkeypatch.setattr(running, "ATTEMPTS", 1)
    wanted = {"quick": True, "scenes": [str(scene)], "tables": ["table2"], "methods": ["TM field"]}
    (tmp_path / "out" / "references").mkdir(parents=True)
    (tmp_path / "out" / "references" / "balls").touch()  # where a folder is to be made
    found = package.reproduce(tmp_path / "out", **wanted, workers=Workers("local", 2))
    assert sorted(found["failed"]) == [f"reference/balls/{light}" for light in ("environment-000", "point-000",
                                                                                "point-001")]
    assert all("cannot make the folder" in why for why in found["failed"].values())
    assert len(found["waiting"]) == 3 and found["done"] == 0


def test_times_are_measured_alone_after_the_rest(tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr(package.sharing, "work", lambda jobs, *_: order.extend(j.name for j in jobs) or {"bad"})
    alone = {"alone": True}
    work = [job("time", lambda: order.append("time") or {}, **alone), job("picture"), job("bad"),
            job("late", partial(pytest.fail, "it needs what failed"), needs=("bad",), **alone)]
    with state.State(tmp_path) as held:
        assert package._shared(work, held, None, Workers("dask", 2)) == {"bad", "late"}
    assert order == ["picture", "bad", "time"]


def test_what_cannot_be_trained_leaves_the_other_columns(scene, tmp_path, monkeypatch):
    mi.set_variant(VARIANT)
    monkeypatch.setattr(package, "QUICK", TINY)
    monkeypatch.setattr(networks.sys, "executable", "false")
    found = package.reproduce(tmp_path / "out", True, [str(scene)], None, ["table2"], ["TM field", "No AG"])
    assert list(found["failed"]) == ["photographs/balls"]
    assert "failed with exit code 1" in found["failed"]["photographs/balls"]
    assert len([n for n in found["waiting"] if n.endswith("/No AG")]) == 3 and "train/balls/no_ag-ray-8" in \
        found["waiting"]
    html = (tmp_path / "out" / "report.html").read_text()
    assert "1 jobs failed" not in html and "1 job failed" in html and "photographs/balls" in html


@pytest.mark.parametrize(("options", "message"), [
    ({"tables": ["table3"]}, "table 'table3' is unknown; it is one of table1, table2, runtime"),
    ({"methods": ["IBL"]}, "method 'IBL' is unknown; it is one of NRF, TM, AG, No AG"),
    ({"scenes": ["cow"]}, r"scene cow has no mesh\.xml; name one of"),
    ({"scenes": ["skull"]}, r"scene skull has no mesh\.xml"),
    ({"scenes": ["statue", "statue"]}, "two of one name"),
    ({"environments": Path("nowhere")}, r"--environments nowhere is no folder; give one with"),
])
def test_bad_names_are_refused_before_the_work(options, message, tmp_path):
    with pytest.raises(MiNtfError, match=message):
        package.reproduce(tmp_path / "out", quick=True, **options)
    assert not (tmp_path / "out").exists()


def test_the_command_line(monkeypatch, capsys):
    calls = []
    result = {"failed": {}, "drops": {}, "done": 3, "jobs": 3, "report": "r.html", "latex": "t.tex"}
    monkeypatch.setattr(package, "reproduce", lambda *args, workers: calls.append((*args, workers)) or result)
    assert cli.main(["reproduce"]) == 0
    assert cli.main(["reproduce", "-o", "x", "--quick", "--scenes", "statue", "knot", "--tables", "table2",
                     "--methods", "NRF", "No AG", "--environments", "maps", "--json", "--engine", "dask", "--workers",
                     "2"]) == 0
    assert calls == [(Path("reproduce"), False, (), None, (), (), Workers()),
                     (Path("x"), True, ("statue", "knot"), Path("maps"), ("table2",), ("NRF", "No AG"),
                      Workers("dask", 2))]
    assert "3 of 3 jobs done\nr.html\nt.tex" in capsys.readouterr().out
    result["failed"] = {"a": "why"}
    assert cli.main(["reproduce", "--json"]) == 1


def test_point_lights_stand_around_the_object():
    """Half move alone; beside the others stands the camera, on the same ray and nearer."""
    centre, eye = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 9.0])
    found = lights.point_lights(40, centre, 0.5, eye)
    places = np.array([light.emitter["position"] for light in found]) - centre
    distance = np.linalg.norm(places, axis=1)
    np.testing.assert_allclose(distance, [1.6] * 20 + [1.6 * 1.02] * 20)
    np.testing.assert_allclose([light.emitter["intensity"] for light in found], np.pi * distance**2)
    assert [light.camera is None for light in found] == [True] * 20 + [False] * 20
    np.testing.assert_allclose([np.subtract(light.camera, centre) * 1.02 for light in found[20:]], places[20:])
    assert np.abs(places[:20].mean(0)).max() < 0.05 and len({light.name for light in found}) == 40
    [shown] = [k for k, light in enumerate(found) if light.shown]
    assert shown < 20 and (places[shown] > 0).all()  # in front of it, above, to the right


def test_environments_are_18_of_one_brightness():
    mi.set_variant(VARIANT)
    found = lights.environments(18)
    images = [np.array(light.emitter["bitmap"]) for light in found]
    assert len({light.title for light in found}) == len({i.tobytes() for i in images}) == 18
    assert [light.title for light in found[:3]] == ["env.exr turned by 0°", "sky, sun 15° high at 20°",
                                                    "sky, sun 40° high at 20°"]
    np.testing.assert_allclose([lights.mean_radiance(i) for i in images], lights.mean_radiance(images[0]), rtol=1e-5)
    sky = lights.sky(40, 110)
    v, u = np.unravel_index(sky.sum(2).argmax(), sky.shape[:2])
    assert abs(90 - (v + 0.5) / 32 * 180 - 40) < 6 and abs((u + 0.5) / 64 * 360 - 110) < 6
    assert (sky[16:] == sky[16, 0]).all() and sky[16:].min() > 0


def test_own_environments(tmp_path):
    mi.set_variant(VARIANT)
    with pytest.raises(MiNtfError, match=r"holds no \.hdr or \.exr file"):
        lights.environments(0, tmp_path)
    for name, value in (("b.exr", 3.0), ("a.hdr", 0.5)):
        mi.Bitmap(np.full((4, 8, 3), value, np.float32)).write(str(tmp_path / name))
    found = lights.environments(0, tmp_path)
    assert [light.title for light in found] == ["a.hdr", "b.exr"]
    mean = lights.mean_radiance(lights.read(lights.ENVIRONMENT))
    np.testing.assert_allclose(np.array(found[1].emitter["bitmap"]), mean, rtol=1e-4)
    uneven = np.random.default_rng(0).uniform(0.5, 1, (4, 8, 3)).astype(np.float32)
    for name, image in (("b.exr", uneven), ("c.exr", np.ascontiguousarray(uneven[:, ::-1]))):
        mi.Bitmap(image).write(str(tmp_path / name))
    _, one, mirrored = lights.environments(0, tmp_path)
    assert one.about != mirrored.about  # pictures under one of them are none of the other
    mi.Bitmap(np.zeros((4, 8, 3), np.float32)).write(str(tmp_path / "b.exr"))
    with pytest.raises(MiNtfError, match=r"environment b\.exr is black"):
        lights.environments(0, tmp_path)
