"""The measure of many frames runs; its figures mean something on a quiet machine."""

import pytest

from benchmarks import frames


@pytest.mark.slow
def test_frames_are_cheaper_than_calls_and_need_no_more_memory():
    found = frames.measure(24, 2, 64)
    assert found["ratio"] > 4  # 12 with 120 frames of 256²
    assert found["memory"][1] < 1.02 * found["memory"][0]
    assert len(found["stock"]) == 2 and found["first"] > found["each"]
