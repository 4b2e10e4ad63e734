"""Dr.Jit through Mitsuba's LLVM back end, with the plugins."""

import mitsuba as mi
import pytest
from helpers.variants import VARIANT

import mi_ntf.render


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi
