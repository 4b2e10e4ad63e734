"""The benchmark of other people's objects: its meshes, its scene, and a row of its table."""

import json

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.variants import VARIANT

from benchmarks import objects, tables


@pytest.fixture
def data(tmp_path):
    """A folder that holds a box in place of the downloaded part, and maps that nothing reads."""
    mi.set_variant(VARIANT)
    folder = tmp_path / "data"
    folder.mkdir()
    trimesh.creation.box((2, 4, 6)).apply_translation([7, 0, 0]).export(folder / "fandisk.obj")
    for name in ("st_fagans_interior_1k.hdr", "kiara_1_dawn_1k.hdr"):
        (folder / name).touch()
    return folder


def test_a_scene_holds_the_painted_mesh_in_the_unit_sphere(tmp_path, data):
    file = objects.write_scene(tmp_path / "fandisk-diffuse", data, "fandisk", "diffuse", 8)
    scene = mi.load_file(str(file))
    (mesh,) = scene.shapes()
    box = mesh.bbox()
    np.testing.assert_allclose(box.max, np.array([1, 2, 3]) / np.sqrt(14), rtol=1e-4)
    assert "vertex_color" in str(mi.traverse(mesh)) and len(scene.emitters()) == 1
    normals = np.array(mi.traverse(mesh)["vertex_normals"]).reshape(-1, 3)
    assert np.isclose(np.abs(normals).max(1), 1).all()  # the edges of a box are sharp


def test_a_row_compares_kept_pictures(tmp_path):
    folder = tmp_path / "spot-metal"
    folder.mkdir()
    rng = np.random.default_rng(0)
    meshes = np.dstack([rng.uniform(0.2, 1, (16, 16, 3)), np.ones((16, 16))]).astype(np.float32)
    mi.Bitmap(meshes).write(str(folder / "meshes_lamp.exr"))
    mi.Bitmap(meshes * np.float32([1.1, 1, 0.9, 1])).write(str(folder / "field_lamp.exr"))
    row = objects.row(folder, "lamp")
    np.testing.assert_allclose(row["mean"], (1.1, 1, 0.9), rtol=2e-3)
    assert row["aligned"] < 2e-3 and row["relative_rmse"] == pytest.approx(np.sqrt(2 / 3) * 0.1, rel=0.1)
    text = tables.objects({"rows": [{"object": "spot-metal", **json.loads(json.dumps(row))}]})
    assert "| spot, metal | lamp | 8." in text and "+10.0, +0.0, -10.0 %" in text
