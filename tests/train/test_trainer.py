"""Whole runs on two analytic spheres, and the texts of the errors."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import two_spheres  # noqa: E402

from mi_ntf.core import field_file  # noqa: E402
from mi_ntf.core.errors import MiNtfError  # noqa: E402
from mi_ntf.data import schema  # noqa: E402
from mi_ntf.train import checkpoint, config, train, trainer  # noqa: E402


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return two_spheres.write(tmp_path_factory.mktemp("spheres"))


def test_short_run_learns_the_spheres(photographs, tmp_path):
    """An all-black picture has 11 dB; the field must explain most of what is seen, also after rounding to float16."""
    out = tmp_path / "field.safetensors"
    report = train(photographs, out, steps=180)
    assert report["test"]["srgb"] > 20, report
    header, _ = field_file.load(out)
    assert header.provenance["test"] == report["test"] and header.provenance["steps_done"] == 180
    assert str(tmp_path) not in json.dumps(header.to_json())
    assert report["faults"] == [] and report["kept"] == report["history"][-1]
    assert out.stat().st_size < 4e6
    assert {*tmp_path.iterdir()} == {out, out.with_suffix(".html")}, "checkpoint and temporary files are gone"


@pytest.mark.slow
def test_a_finished_field_learns_another_transmittance(photographs, tmp_path, monkeypatch):
    two_spheres.coarsen(monkeypatch)
    old, new = tmp_path / "old", tmp_path / "new"
    train(photographs, old, steps=8)
    report = train(photographs, new, steps=25, field=old, ntf="logistic", visibility_mlp=True)
    (before, remaining), (after, tensors) = field_file.load(old), field_file.load(new)
    for name, value in remaining.items():
        if name.startswith(("density", "reflectance")):
            assert np.array_equal(tensors[name], value), name
    assert after.architecture.transmittance.components == 1 and after.architecture.visibility is not None
    assert report["field"] == before.provenance and report["test"] == before.provenance["test"]
    assert report["transmittance"]["rms"] < before.provenance["transmittance"]["rms"]
    other = two_spheres.write(tmp_path / "set", {"train": 2, "val": 1, "test": 1}, size=8)
    for split in ("train", "val", "test"):
        path = other / f"transforms_{split}.json"
        data = json.loads(path.read_text())
        data["unit_sphere"]["radius"] *= 1.1
        path.write_text(json.dumps(data))
    with pytest.raises(MiNtfError, match=r"old has its unit sphere .* --field needs the data set"):
        train(other, tmp_path / "f", steps=1, field=old)
    with pytest.raises(MiNtfError, match="--field goes with the preset 'fast' alone"):
        train(photographs, tmp_path / "f", steps=1, field=old, preset="paper")


def run(photographs, out, steps):
    return trainer.Trainer(photographs, out, config.PRESETS["fast"], "fast", steps=steps, seed=3)


def test_same_seed_gives_the_same_losses_and_a_checkpoint_continues_them(photographs, tmp_path):
    torch.set_num_threads(1)
    first, second = run(photographs, tmp_path / "a", 20), run(photographs, tmp_path / "a", 20)
    first.resume()
    second.resume()
    expected = [_step(first) for _ in range(12)]
    assert [_step(second) for _ in range(6)] == expected[:6]
    second.keep()
    second.save()
    third = run(photographs, tmp_path / "a", 20)
    third.resume()
    assert third.clock.step == 6
    assert [_step(third) for _ in range(6)] == expected[6:]
    with pytest.raises(MiNtfError, match=r"belongs to a run with other settings.*delete the file"):
        run(photographs, tmp_path / "a", 21).resume()


def test_a_checkpoint_is_not_taken_up_on_other_data(tmp_path):
    """By content: the same pictures in new files go on; one pixel changed does not, and is named."""
    data = two_spheres.write(tmp_path / "data", {"train": 2, "val": 1, "test": 1}, size=8)
    first = run(data, tmp_path / "f", 20)
    first.clock.step = 7
    first.keep()
    first.save()
    for path in data.rglob("*.exr"):
        schema.write_exr(path, schema.read_image(path))
    again = run(data, tmp_path / "f", 20)
    again.resume()
    assert again.clock.step == 7
    path = data / "train" / "0000.exr"
    schema.write_exr(path, schema.read_image(path) * np.where(np.arange(64).reshape(8, 8, 1) == 27, 0.9, 1))
    with pytest.raises(MiNtfError, match=r"f\.ckpt belongs to a run on other data: photographs or masks changed since; "
                                         "put back what the run began with, or delete the file to start anew"):
        run(data, tmp_path / "f", 20).resume()


def test_a_checkpoint_of_another_version_is_refused(tmp_path):
    path = tmp_path / "f.ckpt"
    torch.save({"identity": {"data": {}}, "state": {}}, path)
    with pytest.raises(MiNtfError, match=r"f\.ckpt was written by another version of mi_ntf; delete it to start anew"):
        checkpoint.read(path, {"data": {}})


def _step(run):
    value = run.recipe.advance()
    run.clock.step += 1
    return value


@pytest.mark.parametrize(("options", "text"), [
    ({"preset": "quick"}, "preset 'quick' is unknown; it is one of fast"),
    ({"ntf": "mixture9"}, "--ntf 'mixture9' is unknown; it is one of mixture2, logistic, ray, paper"),
    ({"minutes": 1, "steps": 10}, "both --minutes 1 and --steps 10 are given"),
    ({"steps": 0}, "--steps is 0; it must be positive"),
    ({"minutes": float("nan")}, "--minutes is nan; it must be positive"),
])
def test_bad_options(photographs, tmp_path, options, text):
    with pytest.raises(MiNtfError, match=text):
        train(photographs, tmp_path / "f", **options)


def test_bad_photographs(tmp_path):
    folder = two_spheres.write(tmp_path / "set", {"train": 2, "val": 1, "test": 1}, size=8)
    bad = schema.read_image(folder / "train/0001.exr")
    bad[3, 4] = np.nan
    schema.write_exr(folder / "train/0001.exr", bad)
    with pytest.raises(MiNtfError, match=r"0001\.exr: 1 pixels are NaN"):
        train(folder, tmp_path / "f", steps=1)
    path = folder / "transforms_val.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"frames": []}))
    schema.write_exr(folder / "train/0001.exr", np.nan_to_num(bad))
    with pytest.raises(MiNtfError, match="'frames' is empty"):
        train(folder, tmp_path / "f", steps=1)
    assert not (tmp_path / "f").exists()


def test_a_light_away_from_the_camera_is_refused_by_what_cannot_have_it(tmp_path):
    """By the paper's recipe, and by the search for a light whose place the data set tells; one photograph's does."""
    folder = two_spheres.write(tmp_path / "set", {"train": 2, "val": 1, "test": 1}, size=8)
    path = folder / "transforms_train.json"
    data = json.loads(path.read_text())
    data["frames"][1]["pl_pos"][0] += 1.0
    path.write_text(json.dumps(data))
    with pytest.raises(MiNtfError, match=r"the preset 'paper' needs a flash at the lens, .* the preset 'fast'"):
        train(folder, tmp_path / "f", steps=1, preset="paper")
    with pytest.raises(MiNtfError, match="--flash-offset estimate: the data set says where its lights are; leave"):
        train(folder, tmp_path / "f", steps=1, estimate=True)
    assert not (tmp_path / "f").exists()
