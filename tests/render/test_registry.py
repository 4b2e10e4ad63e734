"""Additions to the registries work everywhere: a visibility method and a kind of emitter, one entry each."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import emitters, scenes

import mi_ntf.render
from mi_ntf.infer.visibility import REGISTRY
from mi_ntf.infer.visibility.method import Method
from mi_ntf.render.commands.explain import explain
from mi_ntf.render.lights import light_rows
from mi_ntf.render.lights.scene_lights import Lights

SCENE = Path(__file__).parents[2] / "scenes" / "statue" / "scene.xml"


class Share:
    """The same share of each light reaches every point."""

    def __init__(self, share: float):
        self.share = share

    def tau(self, x, wi, distance, index, active, sun=None):
        return dr.full(type(x[0]), self.share, dr.width(x[0]))


@pytest.fixture
def half(variant, monkeypatch):
    mi_ntf.render.register()
    for name, share in (("all", 1.0), ("half", 0.5)):
        method = Method(name, "a share of each light", lambda *about, share=share: Share(share))
        monkeypatch.setitem(REGISTRY, name, method)


@pytest.mark.parametrize("light", ["point", "constant", "area"])
def test_a_method_of_a_registry_entry(half, tmp_path, light):
    """Half of the light makes a picture half as bright: summed lights and drawn ones."""
    field, center, radius = scenes.write_blobs(tmp_path), np.array(scenes.SIMILARITY.center), scenes.SIMILARITY.radius
    dark, bright = (
        scenes.render(scenes.scene(field, {"type": "nrf", "visibility": name, "hide_emitters": True},
                                   {"light": emitters.emitter(light, center, radius)}, size=8, spp=4))[..., :3]
        for name in ("half", "all"))
    assert bright.max() > 0
    np.testing.assert_allclose(dark, 0.5 * bright, rtol=1e-5, atol=1e-7)


def test_reports_know_the_method(half):
    """`explain` predicts it; a misspelt name lists it."""
    report = explain(SCENE, {"light": "point", "visibility": "half", "res": "8", "spp": "1", "depth": "2"})
    assert report["visibility"] == "half" and report["predicted"]["seconds"] > 0
    with pytest.raises(RuntimeError, match=r"expected one of .* half, auto"):
        mi.load_dict({"type": "nrf", "visibility": "halve"})


def test_a_kind_of_emitter_of_a_registry_entry(variant, monkeypatch):
    """An area light, by default drawn at random, as one point with the power of all."""
    mi_ntf.render.register()

    def rows(emitter, name, limit):
        return light_rows.Rows(np.array([[0.0, 3.0, 0.0]]), np.full((1, 3), 2.0), np.array([True])), None

    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}}
    scene = mi.load_dict({"type": "scene", "lamp": lamp})
    assert Lights(scene).sampled and not len(Lights(scene).rows.power)
    monkeypatch.setitem(light_rows.KINDS, "AreaLight", light_rows.Kind("area", rows, single=True))
    found = Lights(scene)
    assert not found.sampled and found.rows.where.tolist() == [[0.0, 3.0, 0.0]]
