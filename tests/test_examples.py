"""Every example runs, with small settings and a small field, and its result is checked."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from skimage import io

from mi_ntf.core import field_file
from mi_ntf.core.architecture import Architecture, Encoding, Header, Network, Similarity
from mi_ntf.evaluate.compare import read_image

ROOT = Path(__file__).parents[1]


def _run(script, *words):
    words = [sys.executable, ROOT / "examples" / script, *map(str, words)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _blob() -> tuple[Header, dict[str, np.ndarray]]:
    """Return a soft ball: every plane holds a Gaussian, and the product over the three planes is a Gaussian of |x|."""
    planes, small = Encoding("planes", (32,), 1), Encoding("frequency", octaves=0)
    arch = Architecture(Network(planes, (2,)), Network(small, (2,)), Network(small, (2,)))
    tensors = {k: np.zeros(s, np.float32) for k, s in arch.skeleton().items()}
    c = 2 * (np.arange(32) + 0.5) / 32 - 1
    tensors["density.planes.0"][:] = np.exp(-2 * (c[:, None] ** 2 + c[None, :] ** 2))[None, ..., None]  # e^(−4 r²)
    tensors["density.layers.0.weight"][0] = 1
    tensors["density.layers.1.weight"][0, 0] = 12  # ln σ = 12 e^(−4 r²) − 8: 55 at the centre, 1 at r = 0.32
    tensors["density.layers.1.bias"][:] = -8
    tensors["reflectance.layers.1.bias"][:] = [0, 1, 0, 1, 0.5, 0, 0, -3]  # normal up, warm, mostly diffuse
    return Header(arch, Similarity((0.1, 0.8, 0.0), 1.0)), tensors


@pytest.fixture(scope="module")
def blob_scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "statue"
    folder.mkdir()
    for file in ("scene.xml", "sensor.xml", "light_point.xml"):
        shutil.copy(ROOT / "scenes" / "statue" / file, folder)
    text = (folder / "scene.xml").read_text()
    text = re.sub(r'<point name="center".*/>', '<point name="center" x="0.1" y="0.8" z="0"/>', text)
    text = re.sub(r'<float name="radius".*/>', '<float name="radius" value="1"/>', text)
    (folder / "scene.xml").write_text(text)
    field_file.save(folder / "field.safetensors", *_blob())
    return folder / "scene.xml"


@pytest.mark.parametrize("script", sorted(p.name for p in (ROOT / "examples").glob("*.py")))
def test_examples_are_short_and_covered(script):
    assert len((ROOT / "examples" / script).read_text().splitlines()) < 60
    assert f'"{script}"' in Path(__file__).read_text()


def test_relight_moves_the_light(blob_scene, tmp_path):
    out = _run("relight.py", "--scene", blob_scene, "--out", tmp_path, "--frames", 2, "--size", 32, "--spp", 4,
               "--visibility", "raymarch")
    assert out.count(".png") == 2
    front, back = (io.imread(tmp_path / f"relight_{i:03d}.png")[..., :3].astype(float) for i in range(2))
    assert front.mean() > 2  # something is lit
    # Half a turn later the light is on the other side: the bright half of the ball changes.
    assert np.abs(front - back).mean() > 1


def test_volpath_reference_agrees(blob_scene):
    out = _run("volpath_reference.py", "--scene", blob_scene, "--size", 32, "--spp", 256)
    error = float(re.search(r"block means: ([\d.]+)", out)[1])
    assert error < 0.03  # volpath's noise: 8·8·256 paths a block, about 1 %; twice that and the marcher's own


@pytest.mark.slow  # the README's own commands are the same chain
def test_own_mesh_from_photographs_to_an_object_on_its_floor(tmp_path):
    """The floor stays as it is, and lies in the shadow of the field where it lay in that of the meshes."""
    pytest.importorskip("torch")
    printed = _run("own_mesh.py", "--out", tmp_path, "--views", 8, "--size", 32, "--spp", 4, "--steps", 80)
    assert "replaced: box (cube), small_box (cube); kept: floor (rectangle), lamp (point)" in printed
    assert (tmp_path / "compared.png").is_file()
    relit, mesh = (read_image(tmp_path / name)[..., :3].mean(-1) for name in ("relit.exr", "mesh.exr"))
    assert relit.shape == mesh.shape == (96, 96)
    shadow, lit = (slice(50, 55), slice(17, 27)), (slice(86, 94), slice(10, 60))  # of the floor
    assert mesh[shadow].mean() < 0.01 * mesh[lit].mean()
    assert relit[shadow].mean() < 0.8 * relit[lit].mean()  # so short a training leaves fog, through which light passes
    assert relit[lit].mean() == pytest.approx(mesh[lit].mean(), rel=0.2)


def test_three_fields_stand_in_one_picture(tmp_path):
    """The picture shows all three fields on the floor."""
    _run("three_fields.py", "--out", tmp_path / "a.png", "--size", 32, "--spp", 4, "--max-depth", 2)
    image = io.imread(tmp_path / "a.png").astype(float)
    assert image.shape == (32, 48, 3)
    statue, knot, globe = image[19, 24], image[22:30, 3:16].reshape(-1, 3), image[14, 42]
    assert statue[0] > 1.5 * statue[2]  # the red robe
    assert np.ptp(knot[:, 0] - knot[:, 2]) > 50  # red and blue bands
    assert globe[1] > globe[2] or globe[2] > globe[0]  # land or sea
