"""`mi-ntf explain`: what is said is what is done."""

import json
import re
from pathlib import Path

import mitsuba as mi
import pytest
from helpers.programs import run_program
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render import load_scene
from mi_ntf.render.commands.explain import explain, print_table
from mi_ntf.render.cost import measurement, model
from mi_ntf.render.scene.media import find_media

SCENE = Path(__file__).parents[2] / "scenes" / "statue" / "scene.xml"


@pytest.fixture(autouse=True)
def built_in_constants(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def with_integrator(folder: Path, properties: str) -> Path:
    """The shipped scene under its point light, with more `properties` of the integrator."""
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
    assert report["seconds"]["maps or volumes"] == 0 < report["seconds"]["lights"]
    assert "measured" not in report and report["constants"].startswith("built in")


def test_what_is_held_for_a_field():
    """Whatever the lights: 36² maps of 51² texels of two logistics, four halves each."""
    one, many = (explain(SCENE, {"visibility": "transmittance_atlas", "light": light, "res": "16"})
                 for light in ("point", "env"))
    assert one["memory_bytes"]["maps or volumes"] == many["memory_bytes"]["maps or volumes"] == 2 * 36**2 * 51**2 * 8
    assert one["seconds"]["maps or volumes"] == many["seconds"]["maps or volumes"] > 0
    assert not many["effects"]["transmittance maps"]["on"]


def test_a_sun_that_is_marched_to(tmp_path):
    """A sky's, beside which an atlas is looked up; named methods of other kinds have none."""
    sky = '<emitter type="sunsky"><vector name="sun_direction" x="0.4" y="0.5" z="0.7"/></emitter>'
    text = re.sub(r'<include filename="light_\$light.xml"/>', sky, SCENE.read_text())
    assert sky in text
    for name in ("field.safetensors", "sensor.xml"):
        text = text.replace(name, str(SCENE.parent / name))
    (tmp_path / "scene.xml").write_text(text)
    why = {v: explain(tmp_path / "scene.xml", {"visibility": v, "res": "16"})["effects"]["visibility"]["why"]
           for v in ("transmittance_atlas", "raymarch")}
    assert why["transmittance_atlas"].endswith("; marched to 1 that outshine the others")
    assert why["raymarch"] == "raymarch: chosen by name"


def test_auto_chooses_by_the_number_of_shading_points():
    few, some, many = (explain(SCENE, {"light": "env", "res": res, "spp": spp})
                       for res, spp in (("16", "1"), ("64", "4"), ("256", "64")))
    assert few["visibility"] == "raymarch" and some["visibility"] == "transmittance_atlas"
    assert "s by transmittance_atlas, " in some["effects"]["visibility"]["why"]
    assert many["visibility"] == "transmittance_map" and many["effects"]["transmittance maps"]["on"]
    assert many["lights"]["count"] <= 512
    assert many["memory_bytes"]["maps or volumes"] == 8 * 192**2 * many["lights"]["count"]
    assert many["seconds"]["maps or volumes"] > 0


def test_auto_gives_drawn_lights_an_atlas_where_that_pays(tmp_path):
    scene = with_integrator(tmp_path, '<integer name="light_samples" value="8"/>')
    few, many = (explain(scene, {"res": res, "spp": "16"}) for res in ("16", "512"))
    assert few["visibility"] == "raymarch" and many["visibility"] == "transmittance_atlas"
    assert "with 8 drawn ones" in many["effects"]["visibility"]["why"]


def test_auto_follows_the_measured_machine():
    """Where lookups cost more than a march, nothing is held."""
    explain(SCENE, {"light": "env", "res": "256", "spp": "64"})  # registers the plugins
    model.remember(model.Constants(lookup=1e6, atlas=1e6))
    report = explain(SCENE, {"light": "env", "res": "256", "spp": "64"})
    assert report["visibility"] == "raymarch" and report["constants"] == "measured on this machine"


def test_maps_of_mixtures_take_four_times_the_memory(tmp_path):
    scene = with_integrator(tmp_path, '<string name="map_source" value="network"/>')
    report = explain(scene, {"visibility": "transmittance_map"})
    assert report["memory_bytes"]["maps or volumes"] == 4 * 8 * 384**2


def test_memory_of_maps_is_bounded(tmp_path):
    """512 lights of 288 KiB each, 14 of which fit into 4 MiB."""
    scene = with_integrator(tmp_path, '<float name="map_memory" value="4"/>')
    light = f'<include filename="{SCENE.parent}/light_point.xml"/>'
    scene.write_text(scene.read_text().replace(light, '<emitter type="constant"/>'))
    report = explain(scene, {"visibility": "transmittance_map"})
    assert report["lights"]["count"] == 512 and report["memory_bytes"]["maps or volumes"] == 14 * 8 * 192**2


def test_environments_state_their_error(tmp_path, capsys):
    """Fewer lights, more error: an even sky's 512 cells are 3.8° wide, its bound 0.48 %."""
    light, found = f'<include filename="{SCENE.parent}/light_point.xml"/>', []
    for count in (32, 512):
        scene = with_integrator(tmp_path, f'<integer name="environment_lights" value="{count}"/>')
        scene.write_text(scene.read_text().replace(light, '<emitter type="constant" id="sky"/>'))
        report = explain(scene, {"visibility": "none"})
        print_table(report)
        found += report["environments"]
    assert [e["lights"] for e in found] == [32, 512] and {e["emitter"] for e in found} == {"constant emitter (sky)"}
    assert [e["irradiance_error_percent"] for e in found] == pytest.approx([5.5, 0.48], rel=0.05)
    assert found[1]["radius_degrees"] == pytest.approx(3.83, rel=0.02)
    assert "0.48 % of all light" in " ".join(capsys.readouterr().out.split())
    assert explain(SCENE, {"visibility": "none", "light": "point"})["environments"] == []


def test_table_names_every_effect_and_stage(capsys):
    report = explain(SCENE, {"visibility": "none"})
    print_table(report)
    text = capsys.readouterr().out
    assert all(name.split()[0] in text for name in report["effects"])
    assert all(name in text for name in report["seconds"])


@pytest.mark.slow
def test_measured_beside_predicted(tmp_path, capsys):
    """The kernels' seconds are those of the whole render, but for Python and the film. In a process of its own: Dr.Jit
    counts the memory of all that lives in one."""
    words = ("-Dvisibility=transmittance_map", "-Dlight=point", "-Dres=32", "-Dspp=4", "--measure", "--json")
    done = run_program("mi-ntf", "explain", SCENE, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    real = report["measured"]
    assert set(real["stages"]) == set(report["seconds"]) and min(real["stages"].values()) > 0
    assert 0.3 * real["wall_seconds"] < sum(real["stages"].values()) < 2.5 * real["wall_seconds"]  # on two threads
    # The guess of the shading points is made for objects like this one.
    assert 0.5 < real["points"] / report["points"] < 2
    assert 0.5 < real["peak_bytes"] / sum(report["memory_bytes"].values()) < 2
    assert model.measured() is not None and report["constants"] == "measured on this machine"
    print_table(report)
    assert "measured" in capsys.readouterr().out


def test_the_patches_of_bounced_light_are_a_stage_of_their_own(monkeypatch):
    """Their kernels are none of the camera's, though they march and sum lights as those do; they count each time."""
    found, kernels, by_stage = [], [], measurement.by_stage

    def counted(history):
        texts = [k["ir"].getvalue() for k in history if k.get("ir") is not None]
        kernels.append({label: sum(f"loop: {label}\n" in t for t in texts) for label in measurement.LOOPS})
        return by_stage(history)

    monkeypatch.setattr(measurement, "by_stage", counted)
    for depth in ("2", "6"):
        scene = load_scene(SCENE, {"light": "point", "visibility": "raymarch", "res": "16", "spp": "1", "depth": depth})
        found.append(measurement.measure(scene, scene.integrator(), 1))
    single, all_ = found
    assert set(all_["stages"]) - set(single["stages"]) == {"bounces"}
    assert all_["points"] == single["points"] > 0
    assert kernels[0] == kernels[1] and kernels[0]["lights"] > 0
    assert 0 < all_["stages"]["bounces"] < all_["wall_seconds"]


def test_patches_are_counted_before_they_are_found():
    """Within a fifth (measured 0.87, globe 1.08, knot 1.16)."""
    scene = load_scene(SCENE, {"light": "point", "res": "8", "spp": "1"})
    integrator = scene.integrator()
    mi.render(scene, integrator=integrator)
    medium, patches = find_media(scene)[0], integrator.patches.hits.shape[0]
    assert model.patches(medium.field.grid) == pytest.approx(patches, rel=0.2)


def test_stages_by_the_loops_of_kernels():
    class Text(str):
        def getvalue(self):
            return str(self)

    def kernel(label, ms, size):
        return {"ir": Text(f"; Symbolic loop: {label}\n") if label else None, "execution_time": ms, "size": size}

    history = [kernel("ray profile", 8, 100), kernel("camera march", 4, 50), kernel("", 1, 50), kernel("lights", 2, 70),
               {"stage": "bounces", "execution_time": 16},
               kernel("camera march", 4, 50), kernel("lights", 2, 30)]  # fmt: skip
    found = measurement.by_stage(history)
    assert found["points"] == 100
    assert found["stages"] == pytest.approx(
        {"maps or volumes": 8e-3, "camera march": 8e-3, "reflectance": 1e-3, "lights": 4e-3, "bounces": 16e-3})


def test_a_scene_without_our_integrator(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.9.0"><integrator type="path"/></scene>')
    with pytest.raises(MiNtfError, match="its integrator is PathIntegrator, expected"):
        explain(scene, {})
    assert mi.variant() == VARIANT


def test_under_a_limit_the_trials_are_told(monkeypatch, capsys):
    for least in ("LOOK", "TRIAL"):
        monkeypatch.setattr(f"mi_ntf.render.transport.choosing.{least}", 0.0)
    report = explain(SCENE, {"error": "0.1", "res": "24", "spp": "4"})
    trials = report["choice"]["trials"]
    taken = [trial for trial in trials if trial["taken"]]
    assert taken and report["effects"]["visibility"]["why"].endswith(taken[-1]["why"])
    assert report["choice"]["predicted"] == {"seconds": taken[-1]["seconds"], "error": taken[-1]["error"]}
    print_table(report)
    assert "verdict" in capsys.readouterr().out
