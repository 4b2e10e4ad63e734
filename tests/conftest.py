"""Fixtures shared by all tests."""

import os
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from helpers import bakes

os.environ.setdefault("MI_NTF_CACHE", "off")  # tests neither read nor fill the user's cache


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20210922)


@pytest.fixture(autouse=True)
def shared_bakes() -> None:
    """Bake equal fields of different tests once."""
    bakes.share()


@pytest.fixture(autouse=True)
def kept_log_levels() -> Iterator[None]:
    """Restore the log levels of Mitsuba and Dr.Jit, which ``mi-ntf render`` sets for the whole process.

    A package that the test itself imports gets its own default, ``Warn``.
    """
    names = ("mitsuba", "drjit")
    levels = {name: sys.modules[name].log_level() for name in names if name in sys.modules}
    yield
    for name in names:
        if name in sys.modules:
            sys.modules[name].set_log_level(levels.get(name, sys.modules[name].LogLevel.Warn))
