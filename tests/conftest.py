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
    """Give Mitsuba and Dr.Jit the levels back that a render by its command has set for the whole process."""
    packages = [sys.modules[name] for name in ("mitsuba", "drjit") if name in sys.modules]
    packages = [package for package in packages if hasattr(package, "log_level")]
    levels = [package.log_level() for package in packages]
    yield
    for package, level in zip(packages, levels, strict=True):
        package.set_log_level(level)
