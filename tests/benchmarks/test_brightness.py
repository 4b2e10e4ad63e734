"""Brightness of a field beside its mesh: a diffuse ball and a thin skin around it."""

import mitsuba as mi
import pytest
from helpers import fields, pictures
from helpers.variants import VARIANT

from benchmarks import brightness

SCENE = """<scene version="3.9.0">
    <default name="res" value="48"/>
    <integrator type="path"/>
    <sensor type="perspective"><float name="fov" value="22"/>
        <transform name="to_world"><lookat origin="0.3, 0.5, 3.7" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
            <rfilter type="box"/></film>
    </sensor>
    <shape type="sphere"><float name="radius" value="0.5"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf></shape>
</scene>"""


def test_what_bounces_add(tmp_path, monkeypatch):
    """To a ball nothing, of either kind."""
    mi.set_variant(VARIANT)
    (tmp_path / "mesh.xml").write_text(SCENE)
    skin = fields.skin("sphere", 6.0, 0.015, albedo=(0.6, 0.5, 0.4), specular=1e-6)
    path = pictures.save(tmp_path, (skin.header, skin.tensors), "ball")
    every = brightness.lights
    monkeypatch.setattr(brightness, "lights", lambda scene: {"sun": every(scene)["sun"]})
    found = brightness.study(tmp_path / "mesh.xml", path, 16, 3)["sun"]
    assert found["bounces"] == pytest.approx(0, abs=1e-3) and found["mesh_bounces"] == pytest.approx(0, abs=1e-3)


def test_a_balls_skin_is_as_bright_under_all_lights(tmp_path, monkeypatch):
    """Relative to the flash, since the skin is wider than the ball. Without softness: 1.08 under the constant light."""
    mi.set_variant(VARIANT)
    monkeypatch.setattr(brightness, "SPP", {k: v // 4 for k, v in brightness.SPP.items()})  # changes 0.003 of 1
    (tmp_path / "mesh.xml").write_text(SCENE)
    skin = fields.skin("sphere", 6.0, 0.015, albedo=(0.6, 0.5, 0.4), specular=1e-6)
    path = pictures.save(tmp_path, (skin.header, skin.tensors), "ball")
    found = brightness.study(tmp_path / "mesh.xml", path, 32)
    assert list(found) == ["flash", "lamp", "sun", "constant", "sky"]
    for name, row in found.items():
        assert (1 + row["brightness"]) / (1 + found["flash"]["brightness"]) == pytest.approx(1, abs=0.035), name
        assert row["aligned"] <= row["relative_rmse"]  # of silhouettes: the skin is 3 % wider than the ball
