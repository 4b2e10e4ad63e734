"""The study of the learned transmittance, small."""

from pathlib import Path

import mitsuba as mi
import pytest
from helpers.variants import VARIANT

import mi_ntf.render
from benchmarks import transmittance

STATUE = Path(__file__).parents[2] / "scenes/statue/scene.xml"


@pytest.mark.slow
def test_study_of_the_statue():
    """Few pixels and lights: the learned transmittance is within 8 % of the march even so, and every map within 10."""
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    found = transmittance.study(STATUE, 32, 2, 3)
    assert found.pop("ns") > 0
    assert set(found) == set(transmittance.VARIANTS)
    assert 0.001 < found["ray_network"] < 0.08
    assert 0.001 < min(found.values()) and max(found.values()) < 0.10
