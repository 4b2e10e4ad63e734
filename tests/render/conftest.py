"""Dr.Jit through Mitsuba's LLVM back end."""

import mitsuba as mi
import pytest


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")
    return mi
