"""The promise of `max_error` on a few random scenes; on many: ``python tests/hard_cases/promise.py``."""

import importlib.util
from pathlib import Path

import mitsuba as mi
import pytest
from helpers import random_scenes
from helpers.variants import VARIANT

SPEC = importlib.util.spec_from_file_location("promise", Path(__file__).with_name("promise.py"))
promise = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(promise)

FAILED = {
    61: "a further bounce that one path in thousands finds (0.11 for 0.01)",
    92: "two logistics, 0.0208 for 0.02",
    98: "a film of 16 pixels, one of which had all of the error (0.097 for 0.05); 24 seeds have 0.017 together",
    174: "a sun and a sharp lobe: two pixels of 496 had 92 % of the error (0.18 for 0.05)",
}
"""Seeds of 200 whose pictures exceeded a limit, by what the pilot cannot see: what few of a picture's samples meet."""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    mi.set_variant(VARIANT)
    return random_scenes.write_fields(tmp_path_factory.mktemp("fields"))


@pytest.mark.parametrize("seed", [106, *(pytest.param(s, marks=pytest.mark.slow) for s in (4, 9, 165))])
def test_the_error_is_below_the_limit(files, seed):
    """Scenes of which the pilot chose other ways than the whole march."""
    results = promise.errors(seed, files)
    assert results
    for limit, error, choice in results:
        assert error <= limit, f"max_error {limit}: {error} by {choice}"


@pytest.mark.slow
@pytest.mark.parametrize("seed", FAILED)
def test_what_failed_stays_rare(files, seed):
    """At most one of the three limits, as when it was found."""
    results = promise.errors(seed, files)
    assert sum(error > limit for limit, error, _ in results) <= 1


@pytest.mark.slow
def test_at_least_95_of_100_pictures(files):
    counts, _ = promise.check(200, 1000, files, 3600)
    for chosen, _, kept in counts.values():
        assert kept >= promise.KEPT * chosen
