"""Stock volumetric integrators on a field, against each other: which of them are references for ``nrf``."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes, ztest

from mi_ntf.core import field_file

SEEDS = 4
FLOOR = {"type": "rectangle", "bsdf": {"type": "diffuse"}}
SETTINGS = {
    "point": (scenes.light("point"), False),
    "point, floor": (scenes.light("point"), True),
    "constant": ({"type": "constant", "radiance": 0.7}, False),
    "constant, floor": ({"type": "constant", "radiance": 0.7}, True),
}


@pytest.fixture(scope="module")
def fog(tmp_path_factory):
    """σ = 1.5 in the whole sphere: little noise."""
    path = tmp_path_factory.mktemp("fog") / "fog.safetensors"
    field_file.save(path, *fields.uniform(1.5, similarity=scenes.SIMILARITY), np.float32)
    return path


def pictures(fog, integrator: str, setting: str) -> list:
    light, beside = SETTINGS[setting]
    lying = mi.ScalarTransform4f().translate([0.4, -1.8, 0.3]).rotate([1, 0, 0], -90).scale(6)
    shapes = {"floor": {**FLOOR, "to_world": lying}} if beside else {}
    loaded = scenes.scene(fog, {"type": integrator, "max_depth": 2, "hide_emitters": True}, {"light": light}, size=8,
                          shapes=shapes, medium={"resolution": 32})
    return [scenes.render(loaded, seed, 512)[..., :3] for seed in range(SEEDS)]


@pytest.mark.parametrize("setting", SETTINGS)
def test_volpath_and_volpathmis_agree(fog, setting):
    """And ``prbvolpath`` but under environments beside surfaces."""
    references = pictures(fog, "volpath", setting)
    for other in ("volpathmis", "prbvolpath") if setting != "constant, floor" else ("volpathmis",):
        ztest.check(pictures(fog, other, setting), references, f"{other} {setting}", block=2)


def test_prbvolpath_is_no_reference_under_environments_beside_surfaces(fog):
    """It counts what BSDF samples of one bounce more find: 1.10 of the light."""
    found, reference = (np.mean(pictures(fog, i, "constant, floor")) for i in ("prbvolpath", "volpath"))
    assert found > 1.05 * reference
