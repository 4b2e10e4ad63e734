"""Transmittance volumes against the march and closed forms."""


import mitsuba as mi
import numpy as np
import pytest
from helpers import fields
from helpers.jit import arrays
from helpers.volumes import Formula, Unskipped

from mi_ntf.core.spheres import fibonacci
from mi_ntf.infer.grid import baked
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.visibility.raymarch import optical_depth
from mi_ntf.infer.visibility.transmittance_volume import TransmittanceVolume

CUBE = np.stack(np.meshgrid(*[[-0.55, 0.55]] * 3), -1).reshape(-1, 3)
WHERE = np.array([[0.48, 0.6, 0.64], [1.5, 1.0, 2.0], [0.1, 0.5, -0.15]])
IS_POINT = np.array([False, True, True])
DEPTHS = 256


@pytest.fixture
def lights():
    return LightTable(WHERE, np.ones((3, 3)), IS_POINT, 1.0, mi)


def look(volume, lights, x, k):
    x = arrays(x)
    light = lights.sample(mi.UInt32(k), x, True)
    return np.array(volume.tau(x, light.wi, light.distance, mi.UInt32(k), True))


def ball(p):
    """σ = 4 within half a unit of the origin."""
    return mi.Float(4) * mi.Float(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < 0.25)


BALL = Formula(ball, CUBE)


@pytest.mark.parametrize("k", range(3), ids=["directional", "point", "inside"])
def test_uniform_ball_in_closed_form(lights, k, rng):
    """e^−(4 · length inside): entry k holds τ at the far edge of its cell, and an offset by a cell, 1/134, would show
    as a mean error of 4/134 · τ."""
    volume = TransmittanceVolume(lights, 96, DEPTHS, BALL, mi)
    x = rng.normal(size=(2000, 3))
    x *= rng.uniform(0, 0.35, (2000, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
    d = WHERE[k] - x * IS_POINT[k]
    r = np.linalg.norm(d, axis=1)
    d /= r[:, None]
    b = (x * d).sum(1)
    length = np.sqrt(b * b - (x * x).sum(1) + 0.25) - b
    if IS_POINT[k]:
        length = np.minimum(length, r)
    error = look(volume, lights, x, k) - np.exp(-4 * length)
    # Cells of 1/134 begin and end at the ball's surface by halves: 4/268 at most; on average nothing is left of it.
    assert abs(error.mean()) < 1.5e-3 and np.abs(error).max() < 0.03


def test_matter_that_reaches_the_hull(rng):
    """τ is linear from 1, where light enters the hull, through the first entries: e^(−1.5 s), off by (1.5 Δ)²/8 = 0.004
    between them for cells of Δ = 0.11."""
    radius, sun = 0.9, np.array([0.48, 0.6, 0.64])
    fog = Formula(lambda p: mi.Float(1.5), radius * fibonacci(400))
    lights = LightTable(sun[None], np.ones((1, 3)), np.array([False]), 1.0, mi)
    volume = TransmittanceVolume(lights, 64, 16, fog, mi)
    s = rng.uniform(0.03, 0.4, 500)
    x = (radius - s)[:, None] * sun + rng.uniform(-0.02, 0.02, (500, 3))
    np.testing.assert_allclose(look(volume, lights, x, 0), np.exp(-1.5 * (radius - x @ sun)), atol=0.008)


def test_entries_fall_along_every_ray(lights):
    """τ lies in [0, 1] and falls from 1 at the light."""
    volume = TransmittanceVolume(lights, 32, DEPTHS, BALL, mi)
    values = np.array(volume.values).reshape(3, 32 * 32, DEPTHS)
    assert values.max() == 1 and values.min() > 0
    assert np.diff(values, axis=2).max() <= 0
    assert (values[..., 0] == 1).all() and (values[..., -1] < 0.1).any()
    beyond = np.array([[0.48, 0.6, 0.64]]) * 0.95  # between the ball and the sun
    assert look(volume, lights, beyond, 0) == 1


def test_volume_follows_the_march(lights, rng):
    """Lookups at points in the skin and in the shadow of opaque blobs agree with marches."""
    grid = baked(NetworkField(*fields.blobs([(-0.3, 0, 0), (0.35, 0.2, 0.1)], [0.4, 0.25], log_density=4.5), mi),
                     96, mi)
    volume = TransmittanceVolume(lights, 128, 384, grid, mi)
    x = rng.uniform(-0.6, 0.6, (3000, 3))
    for k in range(3):
        light = lights.sample(mi.UInt32(k), arrays(x), True)
        steps = tuple(mi.Float(s) for s in (1 / 512, 1 / 512, 0.1))
        truth = np.exp(-np.array(optical_depth(grid, arrays(x), light.wi, light.distance, steps, mi.Bool(True))))
        error = look(volume, lights, x, k) - truth
        # Bilinear texels of 1/100 (octahedral: 1/50) over skins that are as thin: a few silhouettes blur.
        assert np.abs(error).mean() < (8e-3 if k == 2 else 5e-3) and np.sqrt((error**2).mean()) < 0.03


def test_culling_changes_no_entry(lights):
    """Culling may change entries only beyond e^−12, where the march of a ray ends."""
    grid = baked(NetworkField(*fields.blobs([(-0.3, 0, 0), (0.35, 0.2, 0.1)], [0.4, 0.25], log_density=4.5), mi),
                     96, mi)
    culled, unculled = (np.array(TransmittanceVolume(lights, 32, DEPTHS, volume, mi).values)
                        for volume in (grid, Unskipped(grid)))
    np.testing.assert_allclose(culled, unculled, rtol=1e-4, atol=np.exp(-12))
    assert (unculled < np.exp(-12)).any() and grid.bricks.distances().any()
