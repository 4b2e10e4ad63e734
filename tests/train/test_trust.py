"""Faults rolled back, the best field kept, TensorBoard: on runs of a few steps whose losses are tampered with."""

import functools
import sys
import urllib.request

import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import two_spheres  # noqa: E402

from mi_ntf import page_server  # noqa: E402
from mi_ntf.core import field_file  # noqa: E402
from mi_ntf.core.errors import MiNtfError  # noqa: E402
from mi_ntf.train import config, fast, live, monitor, recipe, train, trainer, training_data  # noqa: E402


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return two_spheres.write(tmp_path_factory.mktemp("spheres"), {"train": 8, "val": 1, "test": 1}, size=16)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    two_spheres.coarsen(monkeypatch)
    monkeypatch.setattr(trainer, "KEEP", 4)
    monkeypatch.setattr(fast.Fast, "carve", functools.partialmethod(fast.Fast.carve, steps=5))
    two_spheres.glance(monkeypatch)


def start(photographs, folder, steps=40):
    return trainer.Trainer(photographs, folder / "f", config.PRESETS["fast"], "fast", steps=steps, seed=3)


def tamper(monkeypatch, name, change):
    """Replace the loss `name`, "field" or "ntf", by ``change(learner, loss)`` before every descent."""
    descend = recipe.Learner.descend

    def changed(learner, loss_name, loss, rate):
        return descend(learner, loss_name, change(learner, loss) if loss_name == name else loss, rate)

    monkeypatch.setattr(recipe.Learner, "descend", changed)


@pytest.mark.parametrize(("name", "step"), [("field", 6), ("ntf", 14)])
def test_a_nan_is_rolled_back_and_reported(photographs, tmp_path, monkeypatch, capsys, name, step):
    def once(learner, loss):
        return loss * float("nan") if learner.clock.step == step and learner.factor == 1 else loss

    tamper(monkeypatch, name, once)
    out = tmp_path / "f"
    report = train(photographs, out, steps=16)
    back = step - step % 4
    assert [f["step"] for f in report["faults"]] == [step]
    assert report["faults"][0]["reason"].startswith(f"the {name} loss is nan")
    assert f"back to step {back}, learning rates × 0.5" in capsys.readouterr().err
    assert report["steps_done"] == 16
    header, _ = field_file.load(out)  # refuses values that are not finite
    assert header.provenance["faults"] == report["faults"]


def test_ctrl_c_says_how_to_go_on(photographs, tmp_path, monkeypatch, capsys):
    """The step is that of the checkpoint from which the same command goes on."""
    pressed = []

    def press(learner, loss):
        if learner.clock.step == 6 and not pressed:
            pressed.append(True)
            raise KeyboardInterrupt
        return loss

    tamper(monkeypatch, "field", press)
    with pytest.raises(KeyboardInterrupt, match="stopped at step 4 of 8; the same command goes on"):
        train(photographs, tmp_path / "f", steps=8)
    assert {*tmp_path.iterdir()} == {tmp_path / "f.ckpt"}
    assert train(photographs, tmp_path / "f", steps=8)["steps_done"] == 8
    said = capsys.readouterr().err
    assert "goes on from step 4\n" in said and "reading photographs" in said and "scoring the field" in said


def test_rolling_back_restores_the_state_and_halves_the_rate(photographs, tmp_path):
    run = start(photographs, tmp_path)
    run.recipe.advance()
    run.clock.step = 1
    run.keep()
    before, sampled = run.state(), torch.rand(1, generator=run.generator)
    run.generator.set_state(before["random"])
    rates = []
    for _ in range(2):
        run.recipe.advance()
        run.clock.step += 1
        rates.append(run.learner.optimizers["field"].param_groups[0]["lr"])
    random = run.generator.get_state()
    run.roll_back(monitor.Fault("a test"))
    after = run.state()
    assert run.clock.step == 1 and run.learner.factor == 0.5
    for name, value in before["parameters"].items():
        assert torch.equal(value, after["parameters"][name]), name
    for name in ("field", "ntf"):
        for index, moments in before["learner"]["optimizers"][name]["state"].items():
            for key, value in moments.items():
                assert torch.equal(value, after["learner"]["optimizers"][name]["state"][index][key]), (name, index, key)
    assert torch.equal(random, after["random"]), "the batch that failed does not come again"
    assert not torch.equal(sampled, torch.rand(1, generator=run.generator))
    run.recipe.advance()
    assert run.learner.optimizers["field"].param_groups[0]["lr"] == rates[0] / 2


def test_four_faults_end_the_run_without_a_file(photographs, tmp_path, monkeypatch):
    tamper(monkeypatch, "field", lambda learner, loss: loss * (float("inf") if learner.clock.step == 5 else 1))
    with pytest.raises(MiNtfError, match=r"diverged 4 times.*the field loss is inf.*nothing was written.*--seed"):
        train(photographs, tmp_path / "f", steps=16)
    assert not list(tmp_path.iterdir())


def test_a_gradient_that_is_not_finite_changes_no_parameter(photographs, tmp_path, monkeypatch):
    """A finite loss with an infinite slope: the square root at 0."""
    run = start(photographs, tmp_path)
    before = {k: v.detach().clone() for k, v in run.recipe.networks.tensors.items()}
    tamper(monkeypatch, "field", lambda learner, loss: loss + (loss - loss.detach()).sqrt())
    with pytest.raises(monitor.Fault, match=r"the field loss is \d\.\d+ and its gradient's length (nan|inf) at step 0"):
        run.recipe.advance()
    assert all(torch.equal(v, before[k]) for k, v in run.recipe.networks.tensors.items())


def test_watch_finds_a_loss_that_runs_away_and_forgives_outliers():
    watch = monitor.Watch()
    for step in range(100):
        watch.check("field", 50.0 if step % 10 == 0 and step else 0.5, step)
    watch.check("ntf", 1e-9, 100)
    for step in range(200):  # far above its average, but small for a loss of colours or transmittances
        watch.check("ntf", 0.01, step)
    for step in range(9):
        watch.check("field", 50.0, step)
    with pytest.raises(monitor.Fault, match=r"field loss is 50 at step 9, over 20 times its running average 0\.5 "):
        watch.check("field", 50.0, 9)
    with pytest.raises(monitor.Fault, match="the ntf loss is inf at step 7"):
        watch.check("ntf", float("inf"), 7)


@pytest.mark.slow
def test_the_best_field_is_the_one_that_is_written(photographs, tmp_path, monkeypatch):
    """The field is spoilt after step 30 of 40, all its matter thinned out; the one before is kept."""
    tensors = {}

    def spoil(learner, loss):
        if learner.clock.step >= 30:
            with torch.no_grad():
                tensors["density.layers.1.bias"] -= 3
        return loss

    tamper(monkeypatch, "field", spoil)
    monkeypatch.setattr(fast.Fast, "carve", functools.partialmethod(fast.Fast.carve, steps=60))
    fields = {}
    validate = trainer.Trainer.validate

    def validated(run):
        tensors.update(run.recipe.networks.tensors)
        fields[run.clock.step] = {k: v.detach().clone() for k, v in tensors.items()}
        return validate(run)

    monkeypatch.setattr(trainer.Trainer, "validate", validated)
    report = train(photographs, tmp_path / "f", steps=40)
    best = max(report["history"], key=lambda entry: entry["psnr"])
    assert report["kept"] == best and best["step"] <= 30 and report["history"][-1]["psnr"] < best["psnr"] - 0.02
    _, written = field_file.load(tmp_path / "f")
    for name, value in fields[best["step"]].items():
        if name.split(".")[0] != "transmittance":  # that one has learnt from the field since
            expected = value.half().float() if ".planes." in name else value
            assert torch.equal(torch.tensor(written[name]), expected), name


def test_tensorboard_gets_scalars_and_previews(photographs, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard", reason="pip install 'mi-ntf[train]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    report = train(photographs, tmp_path / "f", steps=40, tensorboard=tmp_path / "f.tb")
    events = EventAccumulator(str(tmp_path / "f.tb"))
    events.Reload()
    names = {"loss/colour", "loss/alpha", "loss/transmittance", "learning rate/field", "learning rate/ntf",
             "speed/rays per second", "speed/samples per second", "memory GiB", "validation/PSNR dB"}
    assert names <= set(events.Tags()["scalars"])
    assert [e.step for e in events.Scalars("learning rate/field")] == [20, 40]
    psnr = {e.step: e.value for e in events.Scalars("validation/PSNR dB")}
    assert psnr == pytest.approx({e["step"]: e["psnr"] for e in report["history"]}, rel=1e-6)  # stored as float32
    assert 1e2 < events.Scalars("speed/rays per second")[-1].value < 1e7
    picture = events.Images(events.Tags()["images"][0])[-1]
    assert (picture.width, picture.height) == (3 * 16, 16)


@pytest.mark.slow
def test_a_run_that_is_watched_shows_its_pictures_and_learns_the_same(photographs, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="pip install 'mi-ntf[view]'")
    shown, pages = [], []
    monkeypatch.setattr(page_server.Background, "show", lambda background, image: shown.append(image))

    def show(self, step, psnr, picture):
        self._next = 0.0  # a run of a second has no time for pictures
        pages.append(urllib.request.urlopen(self.address).read())
        real(self, step, psnr, picture)

    real = live.Live.show
    monkeypatch.setattr(live.Live, "show", show)
    for name, view in (("watched", True), ("alone", False)):
        train(photographs, tmp_path / name, steps=20, view=view)
    assert len(shown) == 1 and all(b"<html" in page for page in pages)
    photograph = shown[-1][:, :16]
    assert shown[-1].shape[1] == 3 * 16 and photograph.max() > 50  # not the dark around it alone
    fields = [field_file.load(tmp_path / name)[1] for name in ("watched", "alone")]
    assert all((fields[0][key] == fields[1][key]).all() for key in fields[0])


def test_no_tensorboard_is_a_clear_error(photographs, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MiNtfError, match=r"--tensorboard .*tb needs the package .*pip install 'mi-ntf\[train\]'"):
        train(photographs, tmp_path / "f", steps=1, tensorboard=tmp_path / "tb")


def test_skins_get_steeper_once_around_the_surface(photographs, tmp_path, monkeypatch):
    """ln σ → SURFACE_LEVEL + steepen (ln σ − SURFACE_LEVEL) everywhere, at its share of the run and never again; smoke
    has no skin."""
    run = start(photographs, tmp_path, 8)
    method = run.recipe
    x = torch.rand(100, 3) - 0.5
    while run.clock.step < 4:
        method.advance()
        run.clock.step += 1
    assert not method.course.steep
    before = method.networks.log_density(x).detach()
    method.refresh()
    assert method.course.steep
    expected = fast.SURFACE_LEVEL + method.config.steepen * (before - fast.SURFACE_LEVEL)
    torch.testing.assert_close(method.networks.log_density(x).detach(), expected, rtol=1e-4, atol=1e-4)
    method.refresh()
    torch.testing.assert_close(method.networks.log_density(x).detach(), expected, rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(training_data, "SOLID", 1.0)
    assert start(photographs, tmp_path, 8).recipe.course.steep
