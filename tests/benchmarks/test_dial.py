"""Limits of the integrator: how the figures are computed, and one case end to end."""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import dial


def test_noise_of_sampled_light_is_no_error():
    """Two pictures 5 % too bright, with noise of 20 % that both and their references have for themselves."""
    noise = np.random.default_rng(3).normal(1, 0.2, (4, 300, 300, 3))
    truth, images = noise[:2], 1.05 * noise[2:]
    # Each has a mean square of 1 + 0.04; the common error is 0.05 in all pixels. Its standard error is 0.04 / 300 / √3.
    assert dial.error_of(images, truth, sampled=True) == pytest.approx(0.05, abs=0.005)
    assert dial.error_of(images, truth, sampled=False) > 0.25
    # The error is relative to the common part alone.
    assert dial.error_of(1.05 * truth, truth, sampled=False) == pytest.approx(0.05, rel=0.03)


def test_further_frames_cost_what_the_second_did():
    seconds = [3.0, 1.0, 0.5]
    assert [dial.total(seconds, n) for n in (1, 2, 20)] == [3, 4, 13]


@pytest.mark.slow  # a minute
def test_a_case_end_to_end(tmp_path):
    """The march is the reference, so a fixed choice within the limit always exists."""
    words = [sys.executable, "-m", "benchmarks.dial", "error", "--scenes", "knot", "--lights", "point", "--size", "24",
             "--spp", "2", "--out", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "dial.json").read_text())["values"]["error"]
    assert [r["frames"] for r in rows] == [1, 20]
    for row in rows:
        assert row["scene"] == "knot" and row["error"] <= 1.3 * dial.LIMIT and row["seconds"] > 0
        assert 0 < row["best_seconds"] <= row["march_seconds"]
