"""Lookups beside the march: the computed figures, on few pixels and a small atlas."""

import mitsuba as mi
import pytest
from helpers.variants import VARIANT

import mi_ntf.render
from benchmarks import loops
from mi_ntf.infer import tuning


@pytest.fixture(autouse=True)
def small(monkeypatch):
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    monkeypatch.setattr(tuning, "ATLAS_SIDE", 8)
    monkeypatch.setattr(tuning, "ATLAS_RESOLUTION", 16)
    monkeypatch.setenv("MI_NTF_CACHE", "memory")


@pytest.mark.slow  # its scene is read at full size
def test_random_directions_and_shared_ones():
    rows = loops.loop("knot", loops.QUICK)
    for kind in ("random", "same"):
        march, atlas = (rows[kind][method]["median"] for method in loops.METHODS[:2])
        assert march > 0 and atlas > 0 and rows[kind]["ratio"]["repeats"] == 2 * loops.QUICK.repeats
        assert rows[kind]["ratio"]["min"] <= march / atlas * 1.5 and rows[kind]["ratio"]["max"] >= march / atlas / 1.5


def test_the_shadow_on_the_floor_is_that_of_the_field():
    """The coarse atlas errs by less than a third of the shadow; without the field the floor is brighter."""
    row = loops.floor("knot", loops.Sizes(floor=(24, 16)))
    assert 0 < row["error"] < row["error_of_shadow"] < 1 / 3
    assert 0.5 < row["brightness"] < 0.99
    assert set(row) >= {"raymarch", "transmittance_atlas", "no field"}
    assert row["raymarch"]["ratio"]["median"] == 1
