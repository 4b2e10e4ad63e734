"""Paths, $names and includes in scenes that `mi-ntf swap` writes to other folders."""

import numpy as np
import pytest
from helpers.variants import VARIANT
from render.test_swap import MESH, write
from render.test_swap import _swap as swapped


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path)


def test_paths_move_with_the_output(folder):
    root = swapped(folder, folder.parent / "out" / "deep" / "scene.xml")
    assert [e.get("filename") for e in root.findall("include")] == [
        "../../scene/sensor.xml",
        "../../scene/light_$light.xml",
    ]
    assert root.find("emitter/string").get("value") == "../../scene/env.exr"
    assert root.find("shape/medium/string").get("value") == "../../scene/f.safetensors"
    # The included light names env.exr, which Mitsuba seeks in the main scene's folder and in <path>s.
    assert [p.get("value") for p in root.findall("path")] == ["../../scene", "."]


def test_an_absolute_value_of_a_name_stays(folder):
    (folder / "mesh.xml").write_text(
        f'<scene version="3.9.0"><default name="env" value="{folder / "env.exr"}"/><shape type="cube"/>'
        '<emitter type="envmap"><string name="filename" value="$env"/></emitter></scene>')
    root = swapped(folder, folder.parent / "elsewhere" / "o.xml")
    assert root.find("emitter/string").get("value") == "$env"


def test_paths_follow_the_links_of_folders(folder, tmp_path):
    """Mitsuba opens ../f.safetensors in the folder that a link leads to."""
    deep = tmp_path / "real" / "deep"
    deep.mkdir(parents=True)
    (tmp_path / "link").symlink_to(deep)
    root = swapped(folder, tmp_path / "link" / "o.xml")
    for place in root.findall(".//medium/string[@name='filename']") + root.findall("emitter/string"):
        assert (deep / place.get("value")).is_file()


@pytest.mark.parametrize("name", ["$light.xml", "$light"])
def test_a_name_of_an_include_that_fits_all_files(folder, name):
    """It fits the scene itself, files of other forms, and pictures."""
    (folder / "damaged.xml").write_text("<scene")
    default = "light_point" if name.endswith(".xml") else "light_point.xml"
    (folder / "mesh.xml").write_text(
        f'<scene version="3.9.0"><default name="light" value="{default}"/><include filename="{name}"/>'
        '<shape type="cube"/></scene>')
    assert swapped(folder, folder / "o.xml").find("include").get("filename") == name


def test_names_in_paths(folder):
    (folder / "parts").mkdir()
    (folder / "light_point.xml").rename(folder / "parts" / "light_point.xml")
    (folder / "mesh.xml").write_text(
        '<scene version="3.9.0"><default name="dir" value="parts"/><path value="$dir"/>'
        '<include filename="light_point.xml"/><shape type="cube"/></scene>')
    assert swapped(folder, folder / "o.xml").find("include") is not None


def test_mitsuba_loads_a_swapped_scene_from_another_folder(folder):
    """Mitsuba resolves includes and the files that they name. A stock medium replaces the field here."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(VARIANT)
    mi.Bitmap(np.ones((2, 4, 3), np.float32)).write(str(folder / "env.exr"))
    text = MESH.replace('<emitter type="envmap"><string name="filename" value="env.exr"/></emitter>', "")
    (folder / "mesh.xml").write_text(text)
    out = folder.parent / "elsewhere" / "scene.xml"
    swapped(folder, out)
    text = out.read_text().replace('type="nrf" name="interior"', 'type="homogeneous" name="interior"')
    text = text.replace('<string name="filename" value="../scene/f.safetensors" />', "")
    text = text.replace('<string name="visibility" value="$visibility" />', "")
    out.write_text(text.replace('type="nrf"', 'type="volpath"'))
    scene = mi.load_file(str(out))
    assert scene.environment() is not None and len(scene.emitters()) == 2
    assert scene.sensors()[0].sampler().sample_count() == 64
