"""Durations, counts and sizes in the words of people."""

import pytest

from mi_ntf.core import quantities


@pytest.mark.parametrize(("seconds", "text"), [
    (0, "0 s"), (0.0123, "0.012 s"), (4.5, "4.5 s"), (99.7, "100 s"), (110.4, "110 s"), (125, "2.1 min"),
    (3600, "60 min"), (7300, "2 h"), (4e5, "111 h"),
])
def test_durations(seconds, text):
    assert quantities.duration(seconds) == text


@pytest.mark.parametrize(("number", "text"), [
    (7, "7"), (999, "999"), (2400, "2.4 thousand"), (2.4e6, "2.4 million"), (310e6, "310 million"), (5e9, "5 billion"),
])
def test_counts(number, text):
    assert quantities.count(number) == text


@pytest.mark.parametrize(("size", "text"), [(12, "12 bytes"), (3_348_156, "3.3 MB"), (2.9e8, "290 MB"), (4e9, "4 GB")])
def test_sizes(size, text):
    assert quantities.size(size) == text
