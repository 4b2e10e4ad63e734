"""Dr.Jit through Mitsuba's LLVM back end, with the plugins. Properties are deterministic: the same examples in every
run, no deadline, since the machine may be busy."""

import mitsuba as mi
import pytest
from hypothesis import settings

import mi_ntf.render

settings.register_profile("hard", deadline=None, derandomize=True, max_examples=6, print_blob=True)


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")
    mi_ntf.render.register()
    return mi
