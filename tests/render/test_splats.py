"""Gaussian splats as a field: the command, the field in memory, and the shadow on a floor."""

import json
import re

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.programs import run_program
from helpers.splats import on_mesh, write_ply

from mi_ntf.cli import main
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.field import Field

MOST_ERROR = 0.03


def floor(thing, integrator: str) -> np.ndarray:
    """A floor in the light of a lamp behind `thing`, seen from below it."""
    camera = {"type": "orthographic", "near_clip": 0.001,
              "to_world": mi.ScalarTransform4f().look_at([0, -1.2, 0], [0, -2, 0], [0, 0, 1]).scale(3),
              "film": {"type": "hdrfilm", "width": 48, "height": 48, "pixel_format": "rgb",
                       "rfilter": {"type": "box"}}}
    ground = mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90).scale(5)
    scene = mi.load_dict({"type": "scene", "sensor": camera, "integrator": {"type": integrator},
                          "floor": {"type": "rectangle", "to_world": ground}, "thing": thing,
                          "lamp": {"type": "point", "position": [1.0, 4.0, 0.5], "intensity": 20.0}})
    return np.array(mi.render(scene, spp=64, seed=mi.UInt32(2)))


def torus(tmp_path) -> trimesh.Trimesh:
    mesh = trimesh.creation.torus(0.8, 0.35, major_sections=96, minor_sections=48)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.2, [1, 0.3, 0]))
    mesh.export(tmp_path / "mesh.ply")
    return mesh


@pytest.mark.parametrize("count", [40_000, pytest.param(150_000, marks=pytest.mark.slow)])
def test_the_shadow_of_splats_is_that_of_their_mesh(tmp_path, count):
    """The shadow counts, not the bright floor: without a field the picture would be far from the mesh's."""
    path = write_ply(tmp_path / "splats.ply", on_mesh(torus(tmp_path), count, flatness=0.2))
    field = Field.from_splats(path)
    mesh = floor({"type": "ply", "filename": str(tmp_path / "mesh.ply")}, "direct")
    assert mesh.min() < 0.05 * mesh.max()
    assert relative_rmse(floor(field.shape(), "nrf"), mesh) < MOST_ERROR


def test_the_command_writes_a_field_that_others_read(tmp_path):
    splats = on_mesh(torus(tmp_path), 500)
    path, output = write_ply(tmp_path / "splats.ply", splats), tmp_path / "field.safetensors"
    done = run_program("mi-ntf", "import", path, "-o", output, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["splats"] == 500 and not report["emissive"] and report["bytes"] == output.stat().st_size
    field, memory = Field.load(output), Field.from_splats(path)
    assert np.allclose(field.density(splats.centres), memory.density(splats.centres), rtol=1e-4)
    info = run_program("mi-ntf", "info", output, cwd=tmp_path)
    assert "scatters  as a surface" in info.stdout and "splats.ply" in info.stdout


def test_far_splats_are_named_with_the_box_that_leaves_them_out(tmp_path, capsys):
    splats = on_mesh(torus(tmp_path), 500)
    splats.centres[::200] *= 40
    path, output = write_ply(tmp_path / "splats.ply", splats), tmp_path / "field.safetensors"
    words = ["import", str(path), "-o", str(output), "--resolution", "32"]
    assert main(words) == 0
    note = r"note: a few splats .* make the box (\d+) times .*; (--bounds=\S+) leaves"
    found = re.search(note, capsys.readouterr().out)
    assert int(found[1]) > 10
    assert main([*words, found[2], "--overwrite"]) == 0
    printed = capsys.readouterr().out
    assert "splats: 497 with" in printed and "note:" not in printed


@pytest.mark.parametrize(("words", "expected"), [
    (["--bounds=0,0,0,1,1"], "expected six numbers"), (["--bounds=1,0,0,0,1,1"], "expected two corners, the lower"),
    (["--scale", "2"], "--scale is for grids"), (["--resolution", "3"], "expected 16 to 2048"),
])
def test_options_that_do_not_fit_are_refused(tmp_path, words, expected):
    path = write_ply(tmp_path / "splats.ply", on_mesh(torus(tmp_path), 100))
    done = run_program("mi-ntf", "import", path, "-o", tmp_path / "field.safetensors", *words, cwd=tmp_path)
    assert done.returncode != 0 and expected in done.stderr and "Traceback" not in done.stderr


def test_options_of_splats_are_refused_for_grids(tmp_path):
    np.save(tmp_path / "grid.npy", np.ones((4, 4, 4), np.float32))
    done = run_program("mi-ntf", "import", tmp_path / "grid.npy", "-o", tmp_path / "a.safetensors", "--emissive",
                       cwd=tmp_path)
    assert done.returncode != 0 and "--emissive is for Gaussian splats" in done.stderr
