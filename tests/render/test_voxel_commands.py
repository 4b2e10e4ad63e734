"""Commands on fields of voxels: a ball of smoke, and one that is denser than a texel resolves."""

import csv
import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_ntf import Field, cli, load_scene
from mi_ntf.data import grids
from mi_ntf.evaluate.tradeoff import references
from mi_ntf.evaluate.tradeoff.ways import Subject
from mi_ntf.importing import import_grid
from mi_ntf.render.maps.building import SAMPLES
from mi_ntf.view.session import Session

SCENE = """<scene version="3.0.0"><default name="x" value="3"/>
  <integrator type="nrf"><string name="visibility" value="transmittance_map"/><integer name="max_depth" value="2"/>
    {more}</integrator>
  <sensor type="perspective"><transform name="to_world"><lookat origin="3,2,5" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
  <emitter type="point"><point name="position" x="$x" y="4" z="2"/></emitter>
  <shape type="sphere"><float name="radius" value="1.8"/><bsdf type="null"/>
    <medium type="nrf" name="interior"><string name="filename" value="{field}"/></medium></shape></scene>"""
RADIUS = 0.7


@pytest.fixture(scope="module", params=[3.0, 300.0], ids=["smoke", "dense"])
def scene(request, tmp_path_factory) -> Path:
    """Return the scene of a ball whose density falls linearly to 0 at its border; its field lies beside it."""
    folder = tmp_path_factory.mktemp("ball")
    z, y, x = np.meshgrid(*[(np.arange(24) + 0.5) / 12 - 1] * 3, indexing="ij")
    density = request.param * np.clip(RADIUS - np.sqrt(x * x + y * y + z * z), 0, None)
    grids.write_vol(folder / "ball.vol", density.astype(np.float32), np.array([[-1.0] * 3, [1.0] * 3]))
    import_grid(folder / "ball.vol", folder / "ball.safetensors", albedo="0.8")
    (folder / "ball.xml").write_text(SCENE.format(field=folder / "ball.safetensors", more=""))
    return folder / "ball.xml"


def run(*words: object) -> None:
    assert cli.main([str(word) for word in words]) == 0


def test_baked_maps_render_as_those_of_the_scene(scene, monkeypatch):
    """Marches that dense smoke has beside its map do not belong to the file."""
    run("bake", scene, "-o", scene.with_name("maps.exr"), "--overwrite")
    named = f'<string name="map_file" value="{scene.with_name("maps.exr")}"/>'
    baked = scene.with_name("baked.xml")
    baked.write_text(SCENE.format(field=scene.with_name("ball.safetensors"), more=named))
    pictures = [np.array(mi.render(load_scene(path, {}), spp=4, seed=1)) for path in (scene, baked)]
    np.testing.assert_allclose(*pictures, rtol=1e-5, atol=1e-6)


def test_voxels_are_not_baked_again(scene, capsys):
    assert cli.main(["bake", "--baked", str(scene)]) == 1
    assert "holds no trained field, and voxels of other fields are read as they are" in capsys.readouterr().err


def test_surface_of_voxels_lies_at_the_level(scene, capsys):
    """The density falls linearly, so half of that of the centre lies at half of the radius, within a voxel."""
    field = Field.load(scene.with_name("ball.safetensors"))
    run("export", scene.with_name("ball.safetensors"), "-o", scene.with_name("ball.ply"), "--overwrite", "--resolution",
        64, "--level", 0.5 * field.density([[0, 0, 0]])[0] * field.radius, "--json")
    mesh = trimesh.load(json.loads(capsys.readouterr().out)["file"], process=False)
    assert mesh.is_watertight and mesh.volume > 0
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), RADIUS / 2, atol=0.04)


def test_swap_puts_voxels_in_place_of_a_mesh(scene):
    """The swapped scene renders as the one that was written by hand, whose sphere is larger."""
    mesh = scene.with_name("mesh.xml")
    shape = '<shape type="sphere" id="ball"/></scene>'
    mesh.write_text(re.sub(r"<integrator.*?</integrator>", '<integrator type="direct"/>',
                           re.sub(r"<shape.*", shape, scene.read_text(), flags=re.S), flags=re.S))
    run("swap", mesh, scene.with_name("ball.safetensors"), "-o", scene.with_name("swapped.xml"), "--overwrite")
    swapped = load_scene(scene.with_name("swapped.xml"), {"visibility": "transmittance_map"})
    assert "field.interior_medium.density" in mi.traverse(swapped)
    assert np.array(mi.render(swapped, spp=64, seed=1)).mean() == pytest.approx(
        np.array(mi.render(load_scene(scene, {}), spp=64, seed=2)).mean(), rel=0.05)


def test_references_of_a_study_march_twice_the_default_steps(scene):
    """The default of the integrator is 0, and stands for at least one step for each voxel."""
    subject = Subject(scene, {})
    assert subject.properties["samples"] == 0
    assert references.marched(subject).properties(subject)["samples"] == 2 * SAMPLES


@pytest.mark.slow
def test_tradeoff_studies_voxels(scene, tmp_path):
    """Methods that have no networks to train have a row, and the others have none."""
    study = scene.with_name("study.xml")
    study.write_text(scene.read_text().replace("transmittance_map", "$visibility").replace(
        "<default ", '<default name="visibility" value="auto"/><default name="spp" value="1"/><default ', 1))
    run("tradeoff", study, "-o", tmp_path, "--budget", "20s")
    with (tmp_path / "tradeoff.csv").open() as file:
        ways = {row["way"] for row in csv.DictReader(file)}
    assert ways >= {"raymarch", "transmittance map", "transmittance atlas", "no shadows", "stock volpath"}
    assert not ways & {"ray network", "neural transmittance", "visibility MLP"}
    assert (tmp_path / "index.html").is_file()


def test_sequence_and_viewer_show_voxels(scene):
    """A frame is the picture of its values; the viewer refines the same picture."""
    table = scene.with_name("values.csv")
    table.write_text("x\n3\n-3\n")
    run("sequence", scene, "--parameters", table, "-o", scene.with_name("frames"))
    frames = [np.array(mi.Bitmap(str(path))) for path in sorted(scene.with_name("frames").glob("*.exr"))]
    single = np.array(mi.render(load_scene(scene, {}), seed=1))
    assert len(frames) == 2 and frames[0].mean() == pytest.approx(single.mean(), rel=0.1)
    view = Session(scene, {}, 16)
    assert np.isfinite(view.preview().image).all() and view.refine(4).image.max() > 0
