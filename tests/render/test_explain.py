"""`mi-ntf explain`: what is said is what is done."""

from pathlib import Path

import mitsuba as mi
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.explain import explain, print_table

SCENE = Path(__file__).parents[2] / "scenes" / "statue" / "scene.xml"


def test_point_light_by_name():
    report = explain(SCENE, {"visibility": "raymarch", "light": "point", "res": "32"})
    assert report["visibility"] == "raymarch" and report["image"] == {"width": 32, "height": 32, "spp": 16}
    assert report["lights"] == {"emitters": ["point"], "count": 1}
    assert report["effects"]["visibility"] == {"on": True, "why": "raymarch: chosen by name"}
    assert not report["effects"]["transmittance maps"]["on"] and report["memory_bytes"]["transmittance maps"] == 0
    assert report["field"]["radius"] == pytest.approx(1.00276791)


def test_auto_chooses_by_the_number_of_shading_points():
    few = explain(SCENE, {"light": "env", "res": "16", "spp": "1"})
    many = explain(SCENE, {"light": "env", "res": "256", "spp": "64"})
    assert few["visibility"] == "raymarch" and "shading points, maps pay from" in few["effects"]["visibility"]["why"]
    assert many["visibility"] == "transmittance_map" and many["effects"]["transmittance maps"]["on"]
    assert many["lights"]["count"] <= 512
    assert many["memory_bytes"]["transmittance maps"] == 8 * 128**2 * many["lights"]["count"]


def test_maps_of_mixtures_take_four_times_the_memory(tmp_path):
    text = SCENE.read_text().replace("field.safetensors", str(SCENE.parent / "field.safetensors"))
    text = text.replace('"light_$light.xml"', f'"{SCENE.parent}/light_point.xml"')
    text = text.replace("sensor.xml", str(SCENE.parent / "sensor.xml"))
    network = '<integrator type="nrf"><string name="map_source" value="network"/>'
    (tmp_path / "scene.xml").write_text(text.replace('<integrator type="nrf">', network))
    report = explain(tmp_path / "scene.xml", {"visibility": "transmittance_map"})
    assert report["memory_bytes"]["transmittance maps"] == 4 * 8 * 128**2


def test_table_names_every_effect(capsys):
    report = explain(SCENE, {"visibility": "none"})
    print_table(report)
    text = capsys.readouterr().out
    assert all(name.split()[0] in text for name in report["effects"])


def test_a_scene_without_our_integrator(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.9.0"><integrator type="path"/></scene>')
    with pytest.raises(MiNtfError, match="its integrator is PathIntegrator; explain reads"):
        explain(scene, {})
    assert mi.variant() == "llvm_ad_rgb"
