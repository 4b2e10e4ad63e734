"""Fixtures shared by all tests."""

import os

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
