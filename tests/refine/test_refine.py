"""Fields that photographs refine, from the command to the file."""

import dataclasses
import json

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from helpers.programs import run_program
from helpers.variants import VARIANT
from refine import shots

import mi_ntf
from mi_ntf.core import field_file, progress, voxels
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import grids, schema
from mi_ntf.importing import of_grid
from mi_ntf.infer.refined import Refinement, packed
from mi_ntf.refine import comparison, refine, refining, saving
from mi_ntf.refine.gains import Gains, products
from mi_ntf.refine.photographs import Camera

BOX = shots.CENTER + shots.RADIUS * np.array([[-0.5] * 3, [0.5] * 3])


@pytest.fixture(autouse=True)
def few_rays(monkeypatch):
    few = {"compared": 1 << 12, "checked": 1 << 12, "differentiated": 1 << 12}
    for name in ("RAYS", "DENSE_RAYS"):
        monkeypatch.setattr(refining, name, few)
    monkeypatch.setattr(comparison, "SHOWN_RAYS", 1 << 13)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Scene of the field with the wrong patch, photographs of the right one, and both fields."""
    mi.set_variant(VARIANT)
    mi_ntf.register()
    folder = tmp_path_factory.mktemp("case")
    right = scenes.write_blobs(folder, log_density=4.0)
    subject = shots.subject(shots.write_scene(folder, right))
    photographs = shots.photograph(subject, folder / "photographs", {"train": 8, "val": 1, "test": 3})
    wrong = folder / "wrong.safetensors"
    shots.with_patch(subject, wrong)
    return shots.write_scene(folder, wrong), photographs, right, wrong


def test_a_patch_is_found_again(case, tmp_path):
    """An albedo that is 20 % too dark in a half of the object comes back, and the other half stays."""
    scene, photographs, right, wrong = case
    report = refine(scene, photographs, tmp_path / "out.safetensors", steps=24, gains=False)
    true, before, after = (shots.albedo(f, photographs).mean(1) for f in (right, wrong, tmp_path / "out.safetensors"))
    patch, rest = before / true < 0.81, before / true > 0.999
    assert after[patch].sum() / true[patch].sum() == pytest.approx(1, abs=0.03)
    assert after[rest].sum() / true[rest].sum() == pytest.approx(1, abs=0.03)
    assert report.improved and report.after < 0.5 * report.before
    header, _ = field_file.load(tmp_path / "out.safetensors")
    assert header.provenance["refined"]["steps"] == 24
    page = (tmp_path / "out.html").read_text()
    assert "closer to the photographs" in page
    assert {p.suffix for p in tmp_path.iterdir()} == {".safetensors", ".html"}


@pytest.fixture(scope="module")
def thin(tmp_path_factory):
    """Scene of smoke with half of its density on the left, photographs of the right one, and both at voxels."""
    mi.set_variant(VARIANT)
    mi_ntf.register()
    folder = tmp_path_factory.mktemp("thin")
    subject = shots.subject(shots.write_scene(folder, scenes.write_blobs(folder, log_density=1.5, phase=0.0)))
    photographs = shots.photograph(subject, folder / "photographs", {"train": 8, "val": 1, "test": 3})
    true = subject.get("log_density").numpy()
    left = (np.array(subject.lattice("log_density").centres()[0]) < -0.1).reshape(true.shape)
    wrong = np.where(left, true - np.log(2), true)
    subject.set({"log_density": mi.TensorXf(wrong)})
    saving.save(subject, folder / "thin.safetensors", {"made": "by a test"})
    return shots.write_scene(folder, folder / "thin.safetensors"), photographs, true, wrong


def test_a_density_comes_back_from_the_file(thin):
    """Baked voxels have the values that were set, and the networks change by the difference."""
    scene, _, true, wrong = thin
    subject = shots.subject(scene)
    again, matter = subject.get("log_density").numpy(), wrong > 0
    np.testing.assert_allclose(again[matter], wrong[matter], atol=2e-3)
    network, centres = subject.original.network, subject.lattice("log_density").centres()
    change = np.array(network.log_density(centres) - network.learned_log_density(centres)).reshape(true.shape)
    np.testing.assert_allclose(change[matter], (wrong - true)[matter], atol=2e-3)


def test_a_refined_field_is_refined_again(thin, tmp_path):
    """A second refinement takes the place of the first, and holds both."""
    scene, _, true, _ = thin
    subject = shots.subject(scene)
    subject.set({"log_density": mi.TensorXf(true)})
    saving.save(subject, tmp_path / "again.safetensors", {"made": "by a test"})
    again = shots.subject(shots.write_scene(tmp_path, tmp_path / "again.safetensors")).get("log_density").numpy()
    np.testing.assert_allclose(again[true > 0], true[true > 0], atol=3e-3)


def test_a_density_is_found_again(thin, tmp_path):
    """Pictures come closer; the density rises on the left, and less than half as far on the right.

    Eight small photographs tell how much a ray meets, not where on it.
    """
    scene, photographs, true, wrong = thin
    report = refine(scene, photographs, tmp_path / "out.safetensors", steps=40, gains=False,
                    parameters=("log_density",))
    assert report.improved and report.after < 0.6 * report.before
    after = shots.subject(shots.write_scene(tmp_path, tmp_path / "out.safetensors")).get("log_density").numpy()
    left, matter = wrong < true, true > 0
    rise = (after - wrong)[left & matter].mean()
    assert 0.4 * np.log(2) < rise < 1.2 * np.log(2)
    assert abs((after - true)[~left & matter].mean()) < 0.4 * rise


def test_roughness_is_refined_with_the_albedo(case, tmp_path):
    """Both are parameters of one run, and the file holds both."""
    scene, photographs, *_ = case
    report = refine(scene, photographs, tmp_path / "out.safetensors", steps=2, parameters=("albedo", "roughness"))
    assert report.parameters == ["albedo", "roughness"]
    _, tensors = field_file.load(tmp_path / "out.safetensors")
    assert tensors["refined.range"].shape == (2, 7) and "refined_density.range" not in tensors


def test_an_interrupted_run_goes_on(case, tmp_path, monkeypatch):
    """Ctrl-C leaves a checkpoint, from which the same command gets the same field; other commands are told."""
    scene, photographs, *_ = case
    out, update = tmp_path / "out.safetensors", progress.Stage.update

    def press(stage, done, text=""):
        if "step 2" in text:
            raise KeyboardInterrupt
        update(stage, done, text)

    refine(scene, photographs, tmp_path / "whole.safetensors", steps=3, gains=False)
    with monkeypatch.context() as patch:
        patch.setattr(progress.Stage, "update", press)
        with pytest.raises(KeyboardInterrupt):
            refine(scene, photographs, out, steps=3, gains=False)
    assert not out.exists() and out.with_suffix(".safetensors.ckpt").is_file()
    with pytest.raises(MiNtfError, match="other seed; repeat that command"):
        refine(scene, photographs, out, steps=3, gains=False, seed=1)
    assert refine(scene, photographs, out, steps=3, gains=False).steps == 3
    one, other = (field_file.load(path)[1] for path in (out, tmp_path / "whole.safetensors"))
    np.testing.assert_array_equal(one["refined.index"], other["refined.index"])
    np.testing.assert_allclose(one["refined.range"], other["refined.range"], rtol=1e-3)
    assert not out.with_suffix(".safetensors.ckpt").exists()


def test_smoke_of_voxels_under_the_flash(tmp_path, monkeypatch):
    """A field file alone is lit by each photograph's flash; a field of voxels becomes one with other colours."""
    monkeypatch.setattr(shots, "SIZE", 16)
    density = np.ones((12, 12, 12), np.float32)
    right, wrong = tmp_path / "right.safetensors", tmp_path / "wrong.safetensors"
    for path, albedo in ((right, 0.8), (wrong, 0.6)):
        voxels.save(path, *of_grid(grids.Grid(2 * density, BOX), albedo))
    subject = shots.subject(right)
    subject._parameters["lamp.position"] = mi.Point3f(shots.LAMP)
    subject._parameters["lamp.intensity.value"] = mi.Color3f(40.0)
    subject._parameters.update()
    photographs = shots.photograph(subject, tmp_path / "set", {"train": 3, "val": 1, "test": 1}, lamp=True)
    report = refine(wrong, photographs, tmp_path / "out.safetensors", steps=8)
    assert report.after < 0.3 * report.before and not report.gains
    lit = shots.CENTER[None] + shots.RADIUS * np.array([[0.2, 0.42, 0.3]])
    found = mi_ntf.Field.load(tmp_path / "out.safetensors").reflectance(lit).albedo
    assert found == pytest.approx(np.full((1, 3), 0.8), abs=0.06)
    header = field_file.load_header(tmp_path / "out.safetensors")
    assert header.reflectance_counts == header.counts and header.provenance["refined"]["parameters"] == ["albedo"]


def test_density_of_voxels(tmp_path, monkeypatch):
    """Smoke that is twice too thin becomes denser under the flash; the file has its density, and the same albedo."""
    monkeypatch.setattr(shots, "SIZE", 16)
    density, fields = np.ones((12, 12, 12), np.float32), []
    for name, factor in (("right", 1.0), ("wrong", 0.5)):
        fields.append(tmp_path / f"{name}.safetensors")
        voxels.save(fields[-1], *of_grid(grids.Grid(factor * density, BOX), 0.8))
    subject = shots.subject(fields[0])
    subject._parameters["lamp.position"] = mi.Point3f(shots.LAMP)
    subject._parameters["lamp.intensity.value"] = mi.Color3f(40.0)
    subject._parameters.update()
    photographs = shots.photograph(subject, tmp_path / "set", {"train": 3, "val": 1, "test": 1}, lamp=True)
    report = refine(fields[1], photographs, tmp_path / "out.safetensors", steps=40, parameters=("density",))
    assert report.after < 0.5 * report.before
    inside = shots.CENTER + shots.RADIUS * np.random.default_rng(0).uniform(-0.4, 0.4, (200, 3))
    out = mi_ntf.Field.load(tmp_path / "out.safetensors")
    assert 0.55 < out.density(inside).mean() < 1.1  # from 0.5; photographs by one lamp tell little of what lies deep
    np.testing.assert_allclose(out.reflectance(inside).albedo, 0.8, atol=1e-3)


def test_cameras_see_what_photographs_show():
    """Rays of Mitsuba's camera are those of the data set's, also of a principal point beside the middle."""
    c2w = np.eye(4)
    c2w[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    c2w[:3, :3] *= np.sign(np.linalg.det(c2w[:3, :3]))
    c2w[:3, 3] = 1, 2, 3
    camera = Camera(20, 10)
    camera.place(c2w, 30.0, np.array([4.0, 7.0]))
    place = mi.Point2f((np.mgrid[:10, :20][::-1].reshape(2, -1) + 0.5) / [[20], [10]])
    ray, _ = camera.sensor.sample_ray(0, 0, place, mi.Point2f(0.5))
    _, expected = schema.pixel_rays(c2w, 30.0, 20, 10, np.array([4.0, 7.0]))
    np.testing.assert_allclose(np.array(ray.d).T, expected.reshape(-1, 3), atol=1e-5)


def test_differences_are_read_as_written():
    """Values at voxels come back, and there is no difference where no block is, whatever the others' signs."""
    from mi_ntf.infer.backend import module

    dj, rng = module(VARIANT), np.random.default_rng(2)
    values = np.zeros((2, 8, 8, 8, 7), np.float32)
    values[0] = rng.uniform(-0.2, -0.1, (8, 8, 8, 7))
    arrays = packed(values, np.array([[1, 2, 0], [2, 2, 0]]), 33)
    voxel = np.array([[8, 16, 0], [11, 18, 3], [15, 23, 7], [28, 28, 28]])
    p = [dj.Float(((voxel[:, k] + 0.5) / 33 * 2 - 1).astype(np.float32)) for k in range(3)]
    one, half = dj.Float(np.ones(4, np.float32)), dj.Float(np.full(4, 0.5, np.float32))
    _, albedo, roughness, specular = Refinement(arrays, dj).apply(((one,) * 3, (half,) * 3, half, (half,) * 3), p)
    found = np.stack([np.array(v) for v in (*albedo, roughness, *specular)], 1) - 0.5
    z, y, x = (voxel[:3, ::-1] % 8).T
    np.testing.assert_allclose(found[:3], values[0, z, y, x], atol=1e-5)
    np.testing.assert_allclose(found[3], 0, atol=1e-6)


def test_gains_follow_the_photographs_and_keep_their_mean():
    """Pictures that are half as bright as one of two photographs have another gain there, and no other mean."""
    gains, picture = Gains(2, fixed=False), np.full((2, 2, 3), 0.5)
    weight = np.ones((2, 2, 3))
    for view, factor in enumerate((1.0, 2.0)):
        gains.add(view, products(picture, picture, factor * picture, weight))
    gains.settle()
    np.testing.assert_allclose(gains.all(), [[1] * 3, [2] * 3])
    for view, factor in enumerate((1.0, 2.0)):
        for _ in range(60):
            gains.add(view, products(2 * picture, 2 * picture, factor * picture, weight))
    np.testing.assert_allclose(gains.all(), [[1] * 3, [2] * 3], rtol=1e-3)
    assert (Gains(2, fixed=True).all() == 1).all()


def test_what_does_not_fit_is_refused(case, thin, tmp_path):
    """Each sentence names the fault and the remedy."""
    scene, photographs, _, wrong = case
    out = tmp_path / "out.safetensors"
    with pytest.raises(MiNtfError, match="'colour' cannot be refined; this field has albedo, specular"):
        refine(scene, photographs, out, parameters=("colour",))
    with pytest.raises(MiNtfError, match="--minutes is -1; it must be positive"):
        refine(scene, photographs, out, minutes=-1)
    with pytest.raises(MiNtfError, match="leave -D and --env out, or give a scene"):
        refine(wrong, photographs, out, defined={"light": "env"})
    stock = tmp_path / "stock.xml"
    stock.write_text(scene.read_text().replace("<integrator type=\"nrf\">", "<integrator type=\"volpath\">").replace(
        '<integer name="environment_lights" value="16"/>', ""))
    with pytest.raises(MiNtfError, match="its integrator is no nrf"):
        refine(stock, photographs, out)
    header, tensors = field_file.load(wrong)
    damaged = {name: value[:, :2] if name == "refined.range" else value for name, value in tensors.items()}
    with pytest.raises(MiNtfError, match=r"refined.range has the shape \(2, 2\), expected 2 × 3 or 7"):
        field_file.save(out, header, damaged)
    assert dataclasses.asdict(header)["provenance"]["refined"] == {"made": "by a test"}
    header, tensors = field_file.load(thin[0].with_suffix(".safetensors"))
    damaged = {name: value[:1] if name == "refined_density.range" else value for name, value in tensors.items()}
    with pytest.raises(MiNtfError, match=r"refined_density.range has the shape \(1, 1\), expected 2 × 1"):
        field_file.save(out, header, damaged)


def test_the_command_ends_well(tmp_path, capsys):
    """The program writes field and page, prints its figures, and ends with exit code 0."""
    wrong = tmp_path / "wrong.safetensors"
    voxels.save(wrong, *of_grid(grids.Grid(np.full((8, 8, 8), 2, np.float32), BOX), 0.6))
    photographs = shots.photograph(shots.subject(wrong), tmp_path / "set", {"train": 3, "val": 1, "test": 1}, lamp=True)
    done = run_program("mi-ntf", "refine", wrong, photographs, "-o", "out.safetensors", "--steps", "1", "--json",
                       cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["steps"] == 1 and (tmp_path / "out.html").is_file()
    field_file.print_summary(field_file.describe(tmp_path / "out.safetensors"))
    assert "refined   albedo, in 1 steps by 4 photographs" in capsys.readouterr().out


def test_training_refuses_a_refined_field(case):
    """Networks alone would be trained, and the differences lost."""
    pytest.importorskip("torch")
    from mi_ntf.train.finished import FinishedField

    with pytest.raises(MiNtfError, match="was refined"):
        FinishedField.load(case[3])
