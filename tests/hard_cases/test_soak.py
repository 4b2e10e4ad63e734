"""A short soak and a few pairs against ``volpath``; the long ones: ``python tests/hard_cases/soak.py``."""

import importlib.util
from pathlib import Path

import mitsuba as mi
import pytest
from helpers import random_scenes
from helpers.variants import VARIANT

SPEC = importlib.util.spec_from_file_location("soak", Path(__file__).with_name("soak.py"))
soak = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(soak)

FAILED = {
    1001: "a map of 9² texels: lanes past the last one divided by 0 and ended the process",
}
"""Seeds whose scenes have failed, each with its fault."""
FAILED_PAIRS: dict[int, str] = {}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    mi.set_variant(VARIANT)
    return random_scenes.write_fields(tmp_path_factory.mktemp("fields"))


def test_a_short_soak(files):
    """Eight scenes that no other run has seen the like of, in one process."""
    assert not soak.soak(8, 0, files, 600)


@pytest.mark.parametrize("seed", FAILED)
def test_seeds_that_have_failed(files, seed):
    found = soak.check(random_scenes.draw(seed, files))
    assert not found or found.startswith("refused"), found


@pytest.mark.parametrize("seed", [
    1, 3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 2)), *FAILED_PAIRS])
def test_pairs_with_volpath(files, seed):
    found = soak.compare(seed, files)
    assert not found, found


@pytest.mark.slow
def test_a_long_soak(files):
    assert not soak.soak(200, 1000, files, 3600)


@pytest.mark.slow
def test_many_pairs(files):
    assert not soak.pairs(60, 0, files, 3600)


def test_failures_are_found(files, monkeypatch):
    """What the soak looks for: numbers that are not finite, dark below black, errors that are no sentence."""
    scene = random_scenes.draw(7, files)
    picture = soak.render(scene)
    for spoilt, text in ((picture * float("nan"), "not finite"), (picture - 1, "are negative")):
        monkeypatch.setattr(soak, "render", lambda what, spoilt=spoilt: spoilt)
        assert text in soak.check(scene)
    monkeypatch.setattr(soak, "render", lambda what: 1 / 0)
    assert soak.check(scene).startswith("exception: ")
    monkeypatch.undo()
    scene.integrator["visibility"] = "raymatch"
    assert 'refused: nrf integrator: visibility is "raymatch"' in soak.check(scene)
