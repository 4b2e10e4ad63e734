"""Dr.Jit through Mitsuba, with the plugins. Properties are deterministic: the same examples in every
run, no deadline, since the machine may be busy."""

import mitsuba as mi
import pytest
from helpers import scenes
from helpers.variants import VARIANT
from hypothesis import settings

import mi_ntf.render

settings.register_profile("hard", deadline=None, derandomize=True, max_examples=6, print_blob=True)


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi


@pytest.fixture(scope="session")
def blobs(tmp_path_factory):
    """A field file of the asymmetric object, σ = 20."""
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)
