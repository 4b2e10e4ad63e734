"""Softness measured in fields with known skins."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields
from helpers.jit import arrays
from helpers.variants import VARIANT

from mi_ntf.core import ops
from mi_ntf.core import skin as formulas
from mi_ntf.infer.grid import baked
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.skin import Softness, measured, scale_height, spread


def of(header, tensors) -> Softness:
    mi.set_variant(VARIANT)
    return measured(baked(NetworkField(header, tensors, mi), 192, mi), mi)


def softness(header, tensors, x) -> np.ndarray:
    return np.array(of(header, tensors)(arrays(x)))


def at_depths(kind: str, heights, n: int = 400) -> np.ndarray:
    """Points (n, 3) at random `heights` above the skin of a plane or a sphere of radius ½."""
    rng = np.random.default_rng(1)
    height = rng.uniform(*heights, (n, 1))
    if kind == "plane":
        return np.concatenate([rng.uniform(-0.3, 0.3, (n, 2)), height], 1)
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True) * np.sqrt(0.25 + height)


@pytest.mark.parametrize("voxels", [1, 2])
def test_sphere(voxels):
    """Exponential skins of scale height δ on a sphere of radius R: the depths in float64, and Chapman's 2δ/(πR), which
    holds for δ ≪ R and a horizon infinitely far off."""
    skin = fields.skin("sphere", 5.0, 0.01 * voxels)
    x = at_depths("sphere", (0, 0.03 * voxels))
    actual = softness(skin.header, skin.tensors, x)
    normal = x / np.linalg.norm(x, axis=1, keepdims=True)
    along = np.cross(normal, [0.6, 0.8, 0.0])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    out, side = (skin.depth(x, d, np.full(len(x), formulas.LENGTH)) for d in (normal, along))
    expected = formulas.CHAPMAN * formulas.squared_horizon(ops, out, side, skin.density(x))
    # Voxels of 1/64: two of them are less than the thinner skin's three scale heights.
    np.testing.assert_allclose(actual, expected, rtol=0.25)
    assert actual.mean() == pytest.approx(expected.mean(), rel=0.05)
    assert actual.mean() == pytest.approx(formulas.CHAPMAN * 2 * skin.scale / (np.pi * 0.5), rel=0.25)


@pytest.mark.parametrize("scale", [0.01, 0.02])
def test_thickness_is_the_scale_height(scale):
    """As in float64; the density falls with the square of the radius, so it is a little less than `scale`."""
    skin = fields.skin("sphere", 3 - np.log(scale), scale)
    x = at_depths("sphere", (0, 6 * scale), 5000)
    out = skin.depth(x, x / np.linalg.norm(x, axis=1, keepdims=True), np.full(len(x), formulas.LENGTH))
    expected = formulas.thickness(out, np.full(len(x), formulas.SOLID), skin.density(x))
    assert of(skin.header, skin.tensors).thickness == pytest.approx(expected, rel=0.03)
    assert expected == pytest.approx(scale, rel=0.2)


@pytest.mark.parametrize("scale", [0.002, 0.005, 0.02])
def test_networks_tell_the_scale_height(scale):
    """As above, without a bake."""
    skin = fields.skin("sphere", 3 - np.log(scale), scale)
    x = at_depths("sphere", (0, 6 * scale), 5000)
    sigma = skin.density(x)
    height = scale / (2 * np.linalg.norm(x, axis=1))
    expected = formulas.thickness(sigma * height, np.full(len(x), formulas.SOLID), sigma)
    mi.set_variant(VARIANT)
    assert scale_height(NetworkField(skin.header, skin.tensors, mi), mi) == pytest.approx(expected, rel=0.02)


def test_plane_is_flat():
    skin = fields.skin("plane", 5.0, 0.02)
    actual = softness(skin.header, skin.tensors, at_depths("plane", (0, 0.06)))
    assert np.median(actual) < 2e-3 and actual.max() < 0.02


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.5])
def test_smoke_has_no_skin(sigma):
    """Thin fog has softness 0."""
    header, tensors = fields.uniform(sigma) if sigma else fields.empty()
    assert not softness(header, tensors, np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))).any()


def test_values_reach_their_neighbours():
    values, known = np.zeros((7, 7, 7), np.float32), np.zeros((7, 7, 7), bool)
    values[3, 3, 3], known[3, 3, 3] = 0.5, True
    actual = spread(values, known)
    assert (actual[1:6, 1:6, 1:6] == 0.5).all() and actual.sum() == 0.5 * 125
