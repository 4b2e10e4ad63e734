"""The paper's table 2 on our scenes: a folder that survives interruptions, jobs that fail alone, a tiny field whole."""

import json
import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from helpers.variants import VARIANT

import mi_ntf.render
from benchmarks import fields, paper_lights, reproduce
from mi_ntf.core import field_file
from mi_ntf.core.architecture import Encoding, Network
from mi_ntf.core.errors import MiNtfError

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


def test_a_run_continues_after_a_kill_within_a_line(tmp_path):
    first = reproduce.Jobs(tmp_path)
    for name in "ab":
        first.do(name, "same", lambda: {"value": 1})
    whole = (tmp_path / "jobs.jsonl").read_bytes()
    (tmp_path / "jobs.jsonl").write_bytes(whole[:-9])  # the kill came while b's line was written
    calls = []
    second = reproduce.Jobs(tmp_path)
    assert set(second.rows) == {"a"}
    for name in "abc":
        second.do(name, "same", lambda name=name: calls.append(name) or {"value": 3})
    assert calls == ["b", "c"]
    third = reproduce.Jobs(tmp_path)
    assert [(name, row["value"]) for name, row in third.rows.items()] == [("a", 1), ("b", 3), ("c", 3)]


def test_other_settings_and_lost_files_are_done_again(tmp_path):
    made, calls = tmp_path / "made.exr", []
    made.touch()
    jobs = reproduce.Jobs(tmp_path / "out")
    for about in ("same", "same", "other", "other"):
        jobs.do("a", about, lambda about=about: calls.append(about) or {}, made)
    assert calls == ["same", "other"]
    made.unlink()
    jobs.do("a", "other", lambda: calls.append("lost") or {}, made)
    assert calls == ["same", "other", "lost"]


def test_a_failing_job_leaves_the_others(tmp_path, capsys):
    def fail():
        raise MiNtfError("no light here; give one")

    jobs = reproduce.Jobs(tmp_path)
    assert jobs.do("bad", "same", fail) is None and jobs.do("good", "same", dict) is not None
    assert jobs.failed == {"bad": "no light here; give one"} and "bad: no light here" in capsys.readouterr().err
    again = reproduce.Jobs(tmp_path)
    assert again.do("good", "same", partial(pytest.fail, "done before")) is not None
    assert again.do("bad", "same", dict) is not None and again.failed == {}


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
    """Command lines of trainings, which take no time here."""
    lines = []

    def run(*words):
        words = [str(w) for w in words]
        lines.append(words)
        if words[0] == "capture":
            Path(words[2]).mkdir()
        elif words[0] == "train":
            ray_field(Path(words[words.index("--field") + 1]), Path(words[words.index("-o") + 1]))

    monkeypatch.setattr(reproduce, "command", run)
    monkeypatch.setattr(fields, "query_time", lambda medium, count: {"median": 1.0})
    return lines


def reproduction(out: Path, scene: Path, methods: list[str], **sizes) -> reproduce.Reproduction:
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return reproduce.Reproduction(out, replace(reproduce.QUICK, **sizes), [reproduce.scene_of(str(scene))], methods)


def test_all_of_it_on_a_tiny_field(scene, trained, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    out, names = tmp_path / "out", ["NRF", "TM", "AG", "NeRV"]
    values = reproduction(out, scene, names).run()
    assert values["failed"] == {}
    assert [w[0] for w in trained] == ["capture", "train", "train"]  # AG, and the curves' early stage
    assert "--visibility-mlp" in trained[1] and "--no-augmentation" not in trained[1]
    pictures = [r for r in rows(out) if "metrics" in r]
    assert len(pictures) == (2 + 1) * 4 and all(r["metrics"]["ms_ssim"] is None for r in pictures)
    by_method = {n: np.mean([r["metrics"]["rmse"] for r in pictures if r["method"] == n]) for n in names}
    assert 0 < by_method["NRF"] < 0.14 and by_method["AG"] > 1.05 * by_method["NRF"]  # random weights: no shadows
    assert by_method["NRF"] < by_method["TM"] < 1.3 * by_method["NRF"]  # 24² texels of a network by hand
    cell = values["accuracy"]["balls"]["point"]["AG"]["rmse"]
    assert cell["images"] == cell["common"] == 2 and cell["drop"] > 0.05
    assert values["seconds"]["environment"]["TM"]["repeats"] == 1
    assert set(values["ablation"]["balls"]) == {"shipped", "AG"} and values["build"]["balls"]["lights"] == [1, 2]
    curves = values["curves"]["curves"]
    assert list(curves) == ["marched", "shipped network", "2 steps", "8 steps", "NeRV"]
    assert curves["marched"][-1] == 1 and curves["marched"][0] < 0.01 and (np.diff(curves["marched"]) > -1e-4).all()
    reproduce.draw(values["curves"], out / "curves.png")
    assert (out / "curves.png").stat().st_size > 5000
    before = len(rows(out))
    (out / "references" / "balls" / "point-001.exr").unlink()  # that one alone is made again
    again = reproduction(out, scene, names).run()
    assert again["accuracy"] == values["accuracy"]
    assert [r["job"] for r in rows(out)[before:]] == ["reference/balls/point-001"]


def test_a_failed_training_leaves_the_other_columns(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce.sys, "executable", "false")
    values = reproduction(tmp_path / "out", scene, ["TM field", "No AG"]).run()
    assert "failed with exit code 1" in values["failed"]["photographs/balls"]
    assert set(values["accuracy"]["balls"]["point"]) == {"TM field"}
    assert len([name for name in values["failed"] if name.endswith("/No AG")]) == 1 + 3  # ablation and pictures


@pytest.mark.parametrize("name", ["cow", "skull"])
def test_scenes_without_meshes_are_refused(name):
    with pytest.raises(MiNtfError, match=rf"scene {name} has no mesh\.xml; name one of"):
        reproduce.scene_of(name)


def test_the_command_line_names_a_missing_scene(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["reproduce", "--quick", "--scenes", "cow", "--out", str(tmp_path)])
    assert reproduce.main() == 1 and "scene cow has no mesh.xml" in capsys.readouterr().err


def test_point_lights_stand_around_the_object():
    """Half move alone; with the others moves the camera, on the same ray and nearer."""
    centre = np.array([1.0, 2.0, 3.0])
    lights = paper_lights.point_lights(40, centre, 0.5)
    places = np.array([light.emitter["position"] for light in lights]) - centre
    distance = np.linalg.norm(places, axis=1)
    np.testing.assert_allclose(distance, [1.6] * 20 + [1.6 * 1.02] * 20)
    np.testing.assert_allclose([light.emitter["intensity"] for light in lights], np.pi * distance**2)
    assert [light.camera is None for light in lights] == [True] * 20 + [False] * 20
    np.testing.assert_allclose([np.subtract(light.camera, centre) * 1.02 for light in lights[20:]], places[20:])
    assert np.abs(places[:20].mean(0)).max() < 0.05 and len({light.name for light in lights}) == 40


def test_environments_are_18_of_one_brightness():
    mi.set_variant(VARIANT)
    skies = paper_lights.environments(18)
    images = [np.array(light.emitter["bitmap"]) for light in skies]
    assert len({light.title for light in skies}) == len({i.tobytes() for i in images}) == 18
    assert [light.title for light in skies[:3]] == ["env.exr turned by 0°", "sky, sun 15° high at 20°",
                                                    "sky, sun 40° high at 20°"]
    means = [paper_lights.mean_radiance(image) for image in images]
    np.testing.assert_allclose(means, means[0], rtol=1e-5)
    sky = paper_lights.sky(40, 110)
    v, u = np.unravel_index(sky.sum(2).argmax(), sky.shape[:2])
    assert abs(90 - (v + 0.5) / 32 * 180 - 40) < 6 and abs((u + 0.5) / 64 * 360 - 110) < 6
    assert (sky[16:] == sky[16, 0]).all() and sky[16:].min() > 0


def test_own_environments(tmp_path):
    mi.set_variant(VARIANT)
    with pytest.raises(MiNtfError, match=r"holds no \.hdr or \.exr file"):
        paper_lights.environments(0, tmp_path)
    for name, value in (("b.exr", 3.0), ("a.hdr", 0.5)):
        mi.Bitmap(np.full((4, 8, 3), value, np.float32)).write(str(tmp_path / name))
    skies = paper_lights.environments(0, tmp_path)
    assert [light.title for light in skies] == ["a.hdr", "b.exr"]
    mean = paper_lights.mean_radiance(paper_lights.read(paper_lights.ENVIRONMENT))
    np.testing.assert_allclose(np.array(skies[1].emitter["bitmap"]), mean, rtol=1e-4)
    uneven = np.random.default_rng(0).uniform(0.5, 1, (4, 8, 3)).astype(np.float32)
    for name, image in (("b.exr", uneven), ("c.exr", np.ascontiguousarray(uneven[:, ::-1]))):
        mi.Bitmap(image).write(str(tmp_path / name))
    _, one, mirrored = paper_lights.environments(0, tmp_path)
    assert one.about != mirrored.about  # pictures under one of them are none of the other
    mi.Bitmap(np.zeros((4, 8, 3), np.float32)).write(str(tmp_path / "b.exr"))
    with pytest.raises(MiNtfError, match=r"environment b\.exr is black"):
        paper_lights.environments(0, tmp_path)
