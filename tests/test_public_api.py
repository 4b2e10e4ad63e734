"""`import mi_ntf`: the public names, and a field from Python against the plugins and closed forms."""

import math
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.programs import run_program
from helpers.variants import VARIANT

import mi_ntf
from mi_ntf.core.errors import MiNtfError

FIELD = Path(__file__).parents[1] / "scenes" / "statue" / "field.safetensors"


@pytest.fixture(scope="module", autouse=True)
def variant() -> None:
    mi.set_variant(VARIANT)


@pytest.fixture(scope="module")
def field(variant) -> mi_ntf.Field:
    return mi_ntf.Field.load(FIELD, 64)


def test_importing_it_imports_nothing_heavy(tmp_path: Path):
    code = """
import sys
import mi_ntf
assert not {"mitsuba", "drjit", "torch", "numpy", "tyro"} & set(sys.modules), sorted(sys.modules)
assert set(mi_ntf.__all__) <= set(dir(mi_ntf))
try:
    mi_ntf.nothing
except AttributeError as error:
    assert "nothing" in str(error)
else:
    raise AssertionError
"""
    done = run_program("python", "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def points_of(field: mi_ntf.Field, count: int = 500) -> np.ndarray:
    return field.center + field.radius * np.random.default_rng(0).uniform(-0.6, 0.6, (count, 3))


def test_density_is_that_of_the_medium(field):
    points = points_of(field)
    medium = mi.load_dict(field.shape() | {"interior": {"type": "nrf", "filename": str(FIELD), "resolution": 64}}
                          ).interior_medium()
    expected = np.array(medium.extinction(mi.Point3f(points.T.astype(np.float32))))
    np.testing.assert_allclose(field.density(points), expected, rtol=1e-5)
    assert (expected > 1).sum() > 5
    assert field.density(field.center + np.array([2 * field.radius, 0, 0])) == 0


def test_transmittance_is_the_integral_of_the_density(field):
    start = points_of(field, 200)
    direction = np.random.default_rng(1).normal(size=(200, 3))
    length = 0.3 * field.radius
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    t = (np.arange(4000) + 0.5) / 4000 * length
    depth = np.array([field.density(x + t[:, None] * d).sum() * length / 4000
                      for x, d in zip(start, unit, strict=True)])
    tau = field.transmittance(start, direction, length)
    # The rule of the midpoint, where coarse voxels let the density rise by orders of magnitude: 0.013 was measured.
    np.testing.assert_allclose(tau, np.exp(-depth), atol=0.02)
    assert np.abs(tau - np.exp(-depth)).mean() < 1e-3 and (tau < 0.5).any() and (tau > 0.99).any()


def test_arrays_of_drjit_give_arrays_of_drjit(field):
    points = points_of(field, 20)
    jit = mi.Point3f(points.T.astype(np.float32))
    assert isinstance(field.density(jit), mi.Float)
    np.testing.assert_array_equal(np.array(field.density(jit)), field.density(points))
    np.testing.assert_array_equal(np.array(field.transmittance(jit, mi.Vector3f(0, 0, 1))),
                                  field.transmittance(points, [0, 0, 2]))


def test_reflectance_has_its_shapes_and_ranges(field):
    normal, albedo, roughness, specular = field.reflectance(points_of(field, 7))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert albedo.shape == specular.shape == (7, 3) and roughness.shape == (7,)
    assert all(((0 <= values) & (values <= 1)).all() for values in (albedo, roughness, specular))


def test_relight_equals_the_scene_written_out(field):
    light = {"type": "point", "position": [1.5, 2.6, 2.7], "intensity": 40.0}
    image = mi_ntf.relight(field, light, size=24, spp=2, seed=3, visibility="raymarch")
    eye = field.center + np.array([0, 0, 4 * field.radius])
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "nrf", "visibility": "raymarch"}, "light": light, "ball": field.shape(),
        "sensor": {"type": "perspective", "fov": 30.0,
                   "to_world": mi.ScalarTransform4f().look_at(eye, field.center, [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 24, "height": 24, "pixel_format": "rgb"}}})
    np.testing.assert_array_equal(image, np.array(mi.render(scene, spp=2, seed=3)))
    assert image.shape == (24, 24, 3) and math.isfinite(image.sum()) and image.max() > 0.1


def test_wrong_arguments_are_named(tmp_path: Path):
    with pytest.raises(MiNtfError, match="resolution is 4, expected 16 to 1024"):
        mi_ntf.Field.load(FIELD, 4)
    with pytest.raises(MiNtfError, match="nothing"):
        mi_ntf.Field.load(tmp_path / "nothing.safetensors")


def test_cleared_caches_hold_nothing(field):
    from mi_ntf.render.scene import loaded

    mi_ntf.clear_caches()
    assert loaded._load.cache_info().currsize == 0
