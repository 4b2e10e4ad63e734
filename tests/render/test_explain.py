"""`mi-ntf explain` says what a render does."""

import json
import re
from pathlib import Path

import mitsuba as mi
import pytest
from helpers.programs import run_program
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render import load_scene, timing
from mi_ntf.render.commands.explain import explain, print_table

SCENE = Path(__file__).parents[2] / "scenes" / "statue" / "scene.xml"


def with_integrator(folder: Path, properties: str) -> Path:
    """Return the shipped scene under its point light, with further `properties` of the integrator."""
    text = SCENE.read_text().replace("field.safetensors", str(SCENE.parent / "field.safetensors"))
    text = text.replace('"light_$light.xml"', f'"{SCENE.parent}/light_point.xml"')
    text = text.replace("sensor.xml", str(SCENE.parent / "sensor.xml"))
    (folder / "scene.xml").write_text(text.replace('<integrator type="nrf">', f'<integrator type="nrf">{properties}'))
    return folder / "scene.xml"


def test_point_light_by_name():
    report = explain(SCENE, {"visibility": "raymarch", "light": "point", "res": "32"})
    assert report["visibility"] == "raymarch" and report["image"] == {"width": 32, "height": 32, "spp": 16}
    assert report["lights"] == {"emitters": ["point"], "count": 1, "drawn": 0}
    assert report["effects"]["visibility"] == {"on": True, "why": "raymarch: chosen by name"}
    assert not report["effects"]["transmittance maps"]["on"] and report["memory_bytes"]["maps or volumes"] == 0
    assert report["fields"][0]["radius"] == pytest.approx(1.00276791)
    assert report["predicted"]["seconds"] > 0 and report["predicted"]["error"] == report["predicted"]["bound"] == 0
    assert "measured" not in report and report["trials"] == []


def test_what_is_held_for_a_field():
    """Tables of a field do not depend on lights: 36² maps of 51² texels of two logistics, four halves each."""
    one, many = (explain(SCENE, {"visibility": "transmittance_atlas", "light": light, "res": "16", "depth": "2"})
                 for light in ("point", "env"))
    assert one["memory_bytes"]["maps or volumes"] == many["memory_bytes"]["maps or volumes"] == 2 * 36**2 * 51**2 * 8
    assert 0 < many["predicted"]["error"] < many["predicted"]["bound"] < 0.05
    assert not many["effects"]["transmittance maps"]["on"]


def test_a_sun_that_is_marched_to(tmp_path):
    """The sun of a sky is marched beside an atlas; other methods have no marched sun."""
    sky = '<emitter type="sunsky"><vector name="sun_direction" x="0.4" y="0.5" z="0.7"/></emitter>'
    text = re.sub(r'<include filename="light_\$light.xml"/>', sky, SCENE.read_text())
    assert sky in text
    for name in ("field.safetensors", "sensor.xml"):
        text = text.replace(name, str(SCENE.parent / name))
    (tmp_path / "scene.xml").write_text(text)
    why = {v: explain(tmp_path / "scene.xml", {"visibility": v, "res": "16", "depth": "2"})["effects"]["visibility"]
           ["why"] for v in ("transmittance_atlas", "raymarch")}
    assert why["transmittance_atlas"].endswith("; marched to 1 that outshine the others")
    assert why["raymarch"] == "raymarch: chosen by name"


def test_auto_counts_camera_rays_times_lights():
    """The reason compares the rays with the 3.4 million rays of an atlas."""
    few, many = (explain(SCENE, {"light": "env", "res": res, "spp": "1", "depth": "2"}) for res in ("16", "96"))
    assert few["visibility"] == "raymarch" and many["visibility"] == "transmittance_atlas"
    assert many["lights"]["count"] == 512
    assert many["effects"]["visibility"]["why"] == (
        "transmittance_atlas: camera rays times lights are 4.7 million, more than the 3.4 million rays that fill an "
        "atlas")
    assert few["effects"]["visibility"]["why"].startswith(
        "raymarch: camera rays times lights are 131 thousand, no more than the 3.4 million")


def test_auto_counts_drawn_lights(tmp_path):
    scene = with_integrator(tmp_path, '<integer name="light_samples" value="8"/>')
    few, many = (explain(scene, {"res": res, "spp": "16", "depth": "2"}) for res in ("16", "256"))
    assert few["visibility"] == "raymarch" and many["visibility"] == "transmittance_atlas"
    assert many["lights"]["drawn"] == 8


def test_maps_of_mixtures_take_four_times_the_memory(tmp_path):
    scene = with_integrator(tmp_path, '<string name="map_source" value="network"/>')
    report = explain(scene, {"visibility": "transmittance_map", "depth": "2", "map": "384"})
    assert report["memory_bytes"]["maps or volumes"] == 4 * 8 * 384**2


def test_memory_of_maps_is_bounded(tmp_path):
    """Maps of 14 lights fit into 4 MiB, at 288 KiB each."""
    scene = with_integrator(tmp_path, '<float name="map_memory" value="4"/>')
    light = f'<include filename="{SCENE.parent}/light_point.xml"/>'
    scene.write_text(scene.read_text().replace(light, '<emitter type="constant"/>'))
    report = explain(scene, {"visibility": "transmittance_map", "depth": "2"})
    assert report["lights"]["count"] == 512 and report["memory_bytes"]["maps or volumes"] == 14 * 8 * 192**2


def test_environments_state_their_error(tmp_path, capsys):
    """Fewer lights err more; 512 cells of an even sky are 3.8° wide, with a bound of 0.48 %."""
    light, environments = f'<include filename="{SCENE.parent}/light_point.xml"/>', []
    for count in (32, 512):
        scene = with_integrator(tmp_path, f'<integer name="environment_lights" value="{count}"/>')
        scene.write_text(scene.read_text().replace(light, '<emitter type="constant" id="sky"/>'))
        report = explain(scene, {"visibility": "none", "depth": "2"})
        print_table(report)
        environments += report["environments"]
    assert [e["lights"] for e in environments] == [32, 512]
    assert {e["emitter"] for e in environments} == {"constant emitter (sky)"}
    assert [e["irradiance_error_percent"] for e in environments] == pytest.approx([5.5, 0.48], rel=0.05)
    assert environments[1]["radius_degrees"] == pytest.approx(3.83, rel=0.02)
    assert "0.48 % of all light" in " ".join(capsys.readouterr().out.split())
    assert explain(SCENE, {"visibility": "none", "light": "point", "depth": "2"})["environments"] == []


def test_table_names_every_effect_within_the_columns_of_the_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    report = explain(SCENE, {"visibility": "none", "res": "16", "depth": "2"})
    report["effects"]["visibility"]["why"] *= 9
    report["predicted"]["seconds"] = 110.4
    print_table(report)
    text = capsys.readouterr().out
    assert max(len(line) for line in text.splitlines() if str(SCENE.parent) not in line) <= 80
    assert re.search(r"time +110 s", text)
    assert all(name.split()[0] in text for name in report["effects"])
    assert "predicted by a pilot" in text and "memory: voxels" in text


@pytest.mark.slow
def test_measured_beside_predicted(tmp_path, capsys):
    """The command runs in its own process, since Dr.Jit counts the memory of the whole process."""
    words = ("-Dvisibility=transmittance_map", "-Dlight=point", "-Dres=128", "-Dspp=16", "-Ddepth=2", "--measure",
             "--json")
    done = run_program("mi-ntf", "explain", SCENE, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    real = report["measured"]
    seconds = real["wall_seconds"] - real["compile_seconds"]
    assert 0 < real["build_seconds"] < seconds
    assert report["predicted"]["seconds"] > 0
    assert sum(report["memory_bytes"].values()) < 2 * real["peak_bytes"]
    print_table(report)
    assert "measured" in capsys.readouterr().out


def test_what_is_built_is_part_of_a_render():
    """Patches count as built, as maps do; a march of single scattering builds nothing."""
    built = {}
    for depth, visibility in (("2", "raymarch"), ("2", "transmittance_map"), ("6", "raymarch")):
        scene = load_scene(SCENE, {"light": "point", "visibility": visibility, "res": "16", "spp": "1", "depth": depth})
        _, seconds = timing.once(scene, scene.integrator(), 1, 0)
        built[depth, visibility] = seconds["build_seconds"]
        assert seconds["build_seconds"] + seconds["compile_seconds"] < seconds["wall_seconds"]
    assert built.pop(("2", "raymarch")) == 0 < min(built.values())


def test_a_scene_without_our_integrator(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.9.0"><integrator type="path"/></scene>')
    with pytest.raises(MiNtfError, match="its integrator is PathIntegrator, expected"):
        explain(scene, {})
    assert mi.variant() == VARIANT


def test_under_a_limit_the_trials_are_told(capsys):
    report = explain(SCENE, {"error": "0.1", "res": "64", "spp": "16", "depth": "2"})
    taken = [trial for trial in report["trials"] if trial["taken"]]
    assert taken and report["effects"]["visibility"]["why"].endswith(taken[-1]["why"])
    assert report["predicted"] == {name: taken[-1][name] for name in ("seconds", "error", "bound")}
    print_table(report)
    assert "verdict" in capsys.readouterr().out
