"""The scene, the files and the references of a study: what makes it another one, and what is refused."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from evaluate import small_study
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.tradeoff import references, study, ways


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return small_study.write(tmp_path_factory.mktemp("tradeoff"))


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


def test_other_content_of_a_file_is_another_study(folder, tmp_path):
    """An environment map that has changed under its name."""
    scene = tmp_path / "scene.xml"
    text = (folder / "one.xml").read_text().replace('value="ball.safetensors"', f'value="{folder}/ball.safetensors"')
    scene.write_text(text.replace("</scene>", '<emitter type="envmap"><string name="filename" value="e.exr"/></emitter>'
                                  "</scene>"))
    keys = []
    for level in (0.5, 2.0):
        mi.Bitmap(np.full((4, 8, 3), level, np.float32)).write(str(tmp_path / "e.exr"))
        keys.append(ways.Subject(scene, {}).key())
    assert keys[0] != keys[1]


def test_a_reference_that_is_missing_is_refused(folder, tmp_path):
    with pytest.raises(MiNtfError, match=r"nowhere\.exr does not exist"):
        study.tradeoff(folder / "one.xml", tmp_path, {}, 5.0, tmp_path / "nowhere.exr")


def test_a_captured_mesh_adds_the_exported_one_and_a_second_error(folder, tmp_path):
    """A scene of other shapes stands for the captured mesh."""
    result = study.tradeoff(folder / "one.xml", tmp_path, {"res": "16"}, 1.0, folder / "one.xml")
    rows = {r["method"]: r for r in result["ways"]}
    assert rows["mesh"]["points"] and "mi-ntf export " in rows["mesh"]["command"]
    assert "are not counted" in rows["mesh"]["note"] and '<shape type="ply">' in rows["mesh"]["xml"]
    assert all("mesh_error" in p for r in rows.values() for p in r["points"])
    assert "to the mesh" in (tmp_path / "index.html").read_text()


@pytest.mark.parametrize(("size", "shrink"), [((900, 900), 4), ((1920, 1080), 8), ((101, 99), 1)])
def test_a_reference_is_shrunk_by_whole_pixels(monkeypatch, size, shrink):
    monkeypatch.setattr(references, "renderer", lambda *_: None)
    monkeypatch.setattr(references, "marched", lambda _: None)
    monkeypatch.setattr(references, "_rate", lambda _: 1e9)
    assert references.choose_shrink(SimpleNamespace(size=size), 1.0, whole=True) == shrink


def test_a_reference_of_another_size_is_refused_before_the_ways(folder, tmp_path):
    scene = tmp_path / "mesh.xml"
    scene.write_text((folder / "one.xml").read_text().replace('value="24"', 'value="40"')
                     .replace('value="ball.safetensors"', f'value="{folder}/ball.safetensors"'))
    with pytest.raises(MiNtfError, match="renders 40×40 pixels where the study's scene has 24×24;"):
        references.captured(ways.Subject(folder / "one.xml", {}), scene, 1, 0.1)
