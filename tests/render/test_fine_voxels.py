"""Default steps follow voxels that are finer than the steps of trained fields."""

import math
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf import Field
from mi_ntf.render.maps import building
from mi_ntf.render.scene.media import find_media

THICK, DEPTH = 3, 3.0
"""Thickness of a layer, voxels, and its optical depth."""


@pytest.fixture(scope="module")
def layer() -> Field:
    """Return a layer across the middle of 2000 voxels, which steps of a 384th of the box miss in part."""
    density = np.zeros((2000, 3, 3), np.float32)
    density[1000 : 1000 + THICK] = DEPTH / (THICK * 2 / 2000)
    return Field.from_grid(density, 0.0, [[-0.2, -0.2, -1], [0.2, 0.2, 1]])


def through(layer: Field | None, integrator: dict, light: dict, **other: dict) -> float:
    """Return the mean radiance of the middle of the layer from above, or of what is behind it."""
    camera = {"type": "orthographic", "film": scenes.film(16), "sampler": {"type": "independent"},
              "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]).scale(0.1)}
    scene = {"type": "scene", "sensor": camera, "integrator": integrator, "light": light, **other}
    loaded = mi.load_dict(scene | ({"field": layer.shape()} if layer else {}))
    return float(np.array(mi.render(loaded, spp=64, seed=3))[..., :3].mean())


def test_camera_rays_see_thin_layers(layer):
    seen = through(layer, {"type": "nrf", "max_depth": 2}, {"type": "constant"})
    assert seen == pytest.approx(np.exp(-DEPTH), rel=0.03)


@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_map"])
def test_lights_shine_through_thin_layers(layer, visibility):
    """A floor below the layer and the camera is lit through the layer alone."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)}
    light = {"type": "directional", "direction": [0, 0, -1]}
    camera = {"type": "orthographic", "film": scenes.film(16),
              "to_world": mi.ScalarTransform4f().look_at([0, 0, -1.5], [0, 0, -2], [0, 1, 0]).scale(0.1)}
    lit, bare = (through(field, {"type": "nrf", "max_depth": 2, "visibility": visibility} if field else
                         {"type": "direct"}, light, floor=floor, sensor=camera) for field in (layer, None))
    assert lit / bare == pytest.approx(np.exp(-DEPTH), rel=0.05)


def test_steps_of_paths_follow_the_voxels(layer):
    """Paths take a third of the default steps at most, and no more than the settings have."""
    fine = medium(layer)
    default = building.samples(fine)
    assert default == fine.field.grid.resolution > 2000
    steps = [building.fewer_samples(SimpleNamespace(samples=n), fine, 128) for n in (0, 96, 8192)]
    assert steps == [128 * default // 384, 96, 128 * default // 384]


def test_other_fields_keep_their_steps():
    """Coarse voxels, and trained fields of thick skins however fine their voxels are, have 384."""
    coarse = medium(Field.from_grid(np.ones((4, 4, 4))))
    assert [building.samples(m) for m in (coarse, trained(0.01))] == [384, 384]


def test_thin_skins_have_finer_steps_and_texels():
    """Steps and texels shrink with skins, to half a voxel; those of thick skins are as fine as the voxels."""
    assert [building.samples(trained(t)) for t in (0.002, 0.001)] == [770, 1024]
    assert [building.texels(trained(t)) for t in (0.01, 0.002, math.inf)] == [512, 770, 512]


def trained(thickness: float):
    """Return a stand-in of the medium of a trained field of 512³ voxels."""
    return SimpleNamespace(field=SimpleNamespace(trained=True, grid=SimpleNamespace(resolution=512),
                                                 softness=SimpleNamespace(thickness=thickness)))


def medium(field: Field):
    """Return the medium of a field in a scene."""
    return find_media(mi.load_dict({"type": "scene", "field": field.shape()}))[0]
