"""Cost of the frames of a sequence, on few and small ones."""

import pytest

from benchmarks import sequence


@pytest.mark.slow
def test_frames_are_cheaper_than_calls_and_need_no_more_memory():
    measured = sequence.measure(24, 2, 64)
    assert measured["ratio"] > 4  # 12 with 120 frames of 256²
    assert measured["memory"][1] < 1.02 * measured["memory"][0]
    assert measured["stock"]["repeats"] == 2 and measured["first"] > measured["each"]["median"]
