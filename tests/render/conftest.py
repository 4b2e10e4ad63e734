"""Dr.Jit through Mitsuba's LLVM back end, with the plugins, and the object that most tests render."""

import mitsuba as mi
import pytest
from helpers import scenes
from helpers.variants import VARIANT

import mi_ntf.render


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi


@pytest.fixture(scope="session")
def blobs(tmp_path_factory):
    """A field file of the asymmetric object, σ = 20."""
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)
