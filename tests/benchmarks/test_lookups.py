"""Lookups beside the march: what the command reckons, on few pixels and a small atlas."""

import mitsuba as mi
import pytest
from helpers.variants import VARIANT

import mi_ntf.render
from benchmarks import dial, lookups
from mi_ntf.infer.visibility import transmittance_atlas


@pytest.fixture(autouse=True)
def small(monkeypatch):
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    monkeypatch.setattr(transmittance_atlas, "SIDE", 8)
    monkeypatch.setattr(transmittance_atlas, "RESOLUTION", 16)
    monkeypatch.setenv("MI_NTF_CACHE", "memory")


@pytest.mark.slow  # its scene is read at full size
def test_directions_of_their_own_and_shared_ones(monkeypatch):
    monkeypatch.setattr(lookups, "LIGHTS", 2)
    monkeypatch.setattr(lookups.loops, "POINTS", 1 << 10)
    row = lookups.loop("knot", 0, 0)
    for way in ("random", "same"):
        march, atlas = (row["ns"][f"{way} {method}"] for method in lookups.METHODS[:2])
        assert march > 0 and atlas > 0 and row["ratio"][way] == pytest.approx(march / atlas)


def test_the_shadow_on_the_floor_is_that_of_the_field(monkeypatch):
    """The coarse atlas sees it within a third (14 % was measured); without the field the floor is brighter."""
    monkeypatch.setattr(lookups, "FLOOR_SPP", 16)
    row = lookups.floor("knot", 24, 0)
    assert 0 < row["error"] < row["error_of_shadow"] < 1 / 3
    path = {"type": "path", "max_depth": 2, "hide_emitters": True}
    lit, shaded = (dial.picture(lookups._floor_scene("knot", method, 24), mi.load_dict(path), 0, 16)[0].mean()
                   for method in ("", "raymarch"))
    assert 0.5 * lit < shaded < 0.99 * lit
