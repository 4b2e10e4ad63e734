"""Dr.Jit through Mitsuba's LLVM back end, and a field of three balls."""

import mitsuba as mi
import pytest
from helpers import fields
from helpers.variants import VARIANT

from mi_ntf.infer.grid import baked
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.profile import DepthProfile


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    return mi


@pytest.fixture(scope="module")
def network():
    mi.set_variant(VARIANT)
    balls = [(-0.3, 0.0, 0.0), (0.35, 0.2, 0.1), (0.0, -0.45, 0.3)], [0.4, 0.25, 0.2]
    return NetworkField(*fields.blobs(*balls, log_density=4.5), mi)


@pytest.fixture(scope="module")
def grid(network):
    return baked(network, 96, mi)


@pytest.fixture(scope="module")
def reader(grid):
    return DepthProfile(grid, mi.Float(1 / 256))
