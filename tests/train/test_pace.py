"""Time of a run: the schedule, what is reserved for scores and page, and the whole of `--minutes`."""

import math
import time

import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import two_spheres  # noqa: E402

from mi_ntf.train import fast, pace, train  # noqa: E402
from mi_ntf.train.config import FastConfig  # noqa: E402
from mi_ntf.train.monitor import Notes  # noqa: E402
from mi_ntf.train.recipe import Clock, Learner, Run  # noqa: E402
from mi_ntf.train.training_data import TrainingData  # noqa: E402


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return two_spheres.write(tmp_path_factory.mktemp("spheres"), {"train": 4, "val": 1, "test": 1}, size=16)


def test_the_schedule_ends_before_the_reserved_time():
    clock = Clock(minutes=2.0, spent=30.0, reserve=20.0)
    assert clock.progress == pytest.approx(0.3) and clock.left == pytest.approx(90.0, abs=1.0)
    clock.begin = 0.5
    assert clock.progress == pytest.approx(0.65)
    assert Clock(steps=40, first=100, step=110, begin=0.5).progress == pytest.approx(0.625)
    assert Clock(steps=40).left == 0.0


def test_time_between_steps_counts():
    clock = Clock(minutes=1.0, last=time.monotonic() - 3.0)
    assert clock.left == pytest.approx(57.0, abs=1.0)
    clock.tick()
    assert clock.spent == pytest.approx(3.0, abs=1.0) and clock.left == pytest.approx(57.0, abs=1.0)


def test_pixels_fit_into_the_time_that_is_left(photographs):
    """Slow machines reserve more time, and render fewer pixels; a run in steps renders all of them."""
    data = TrainingData.load(photographs, Notes(False), {})
    run = pace.Pace(Clock(minutes=1.0), data)
    assert run.clock.reserve == pytest.approx(60 * pace.FINISH_TIME)
    run.fixed, reserved = 2.0, []
    for run.speed in (1e9, 1e5, 2e4, 1e3, 1.0):
        run.reserve()
        reserved.append(run.clock.reserve)
    assert reserved[0] == pytest.approx(2.0, abs=0.01) and reserved == sorted(reserved)
    assert reserved[-1] == 30.0  # half of the run
    run.speed = 1000.0
    assert run.detail(10000.0, run.clock.left - 5.0) == pytest.approx(0.5, abs=0.05)
    assert run.detail(1e9, 0.0) == pace.LEAST and run.detail(1.0, 0.0) == 1.0
    assert pace.Pace(Clock(steps=10), data).detail(math.inf, 0.0) == 1.0


@pytest.mark.parametrize(("spent", "bounce", "earlier", "done"), [
    (5.0, 0.0, 0.0, []), (25.0, 0.0, 0.0, ["flash", "bounce"]), (50.0, 0.0, 0.0, ["flash", "bounce"]),
    (25.0, 0.15, 0.0, ["flash", "bounce"]), (25.0, 0.15, 0.1, ["flash"]), (50.0, 0.15, 0.0, ["flash"])])
def test_slow_runs_find_the_light_once_and_only_if_there_is_time(photographs, spent, bounce, earlier, done,
                                                                 monkeypatch):
    """Several rounds are due at once where a step takes long.

    A round is left out if it does not fit any more, or if it and the `earlier` ones take too much of the run.
    """
    clock = Clock(minutes=1.0, spent=spent)
    run = Run(TrainingData.load(photographs, Notes(False), {}), clock, Learner(clock), Notes(False),
              torch.Generator().manual_seed(0))
    recipe, work = fast.Fast(FastConfig(), run, estimate=True), []
    clock.spent, clock.last, recipe.course.bounce, recipe.course.bounced = spent, time.monotonic(), bounce, earlier

    def stand_in(name, counter):
        def function():
            work.append(name)
            setattr(recipe.course, counter, getattr(recipe.course, counter) + 1)
        return function

    monkeypatch.setattr(recipe, "estimate_flash", stand_in("flash", "estimates"))
    monkeypatch.setattr(recipe, "update_bounced", stand_in("bounce", "rounds"))
    for _ in range(3):
        recipe.find_light()
    assert work == done


def test_a_slow_machine_shapes_a_part_of_the_hull(photographs, monkeypatch):
    """On a machine that takes a second for each step, the hull gets its part of the minute and no more."""
    now = time.monotonic()
    clock = Clock(minutes=1.0, last=now)
    run = Run(TrainingData.load(photographs, Notes(False), {}), clock, Learner(clock), Notes(False),
              torch.Generator().manual_seed(0))
    recipe, steps = fast.Fast(FastConfig(), run), []

    def stand_in(*args: object) -> float:
        steps.append(args)
        clock.last -= 1.0
        return 0.0

    monkeypatch.setattr(run.learner, "descend", stand_in)
    clock.spent, clock.last = 0.0, time.monotonic()
    recipe.carve()
    assert len(steps) <= 60 * fast.HULL_SHARE + 1 and recipe.course.bounce >= fast.BOUNCE_COST * fast.HULL_SHARE


@pytest.mark.slow
def test_a_run_ends_in_time(tmp_path):
    """The minute includes reading, scores and page; 5 % more are allowed."""
    folder = two_spheres.write(tmp_path / "set", {"train": 16, "val": 4, "test": 8}, size=96)
    start = time.monotonic()
    report = train(folder, tmp_path / "f", minutes=1.0)
    seconds = time.monotonic() - start
    assert 48 < seconds < 63 and report["seconds"] < 60
