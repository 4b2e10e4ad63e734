"""The ray network's lookup, the march and the baseline against the rays themselves."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.jit import arrays

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.visibility import raymarch
from mi_ntf.infer.visibility.ray_network import RayNetwork
from mi_ntf.infer.visibility.visibility_mlp import VisibilityMLP


def test_ray_network_is_a_transmittance(network, reader, rng):
    """τ lies in [0, 1], grows towards the light, and is 1 at a light inside the sphere."""
    visibility = RayNetwork(network, reader)
    o, d = rng.uniform(-0.3, 0.3, (200, 3)), rng.normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    t = np.linspace(-0.6, 0.6, 30)
    taus = np.array(
        [np.array(visibility.tau(arrays(o + s * d), arrays(d), mi.Float(np.inf), mi.UInt32(0), True)) for s in t]
    )
    assert (taus >= 0).all() and (taus <= 1).all()
    assert (np.diff(taus, axis=0) >= -1e-5).all()  # the same ray, recomputed from another point in float32
    near = np.array(visibility.tau(arrays(o), arrays(d), mi.Float(np.full(200, 1e-4)), mi.UInt32(0), True))
    np.testing.assert_allclose(near, 1, atol=0.02)  # slopes of some hundred times a ten-thousandth
    beyond = np.array(visibility.tau(arrays(o + 5 * d), arrays(d), mi.Float(np.inf), mi.UInt32(0), True))
    assert (beyond > 0).all()


def test_light_table_units():
    """Irradiance is I/r² in scene units; directional lights have no distance."""
    lights = LightTable([[0, 0, 2.0], [0, 1, 0]], [[8, 4, 2], [1, 2, 3]], [True, False], 3.0, mi)
    light = lights.sample(mi.UInt32([0, 1]), arrays([[0, 0, 0.5], [0.1, 0.2, 0.3]]), True)
    np.testing.assert_allclose(np.array(light.wi).T, [[0, 0, 1], [0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(np.array(light.irradiance).T, [[8 / 20.25, 4 / 20.25, 2 / 20.25], [1, 2, 3]], rtol=1e-6)
    np.testing.assert_allclose(np.array(light.distance), [1.5, np.inf], rtol=1e-6)


def test_raymarch_sees_lights_inside_matter(grid):
    """The march stops at the light."""
    march = raymarch.RayMarch(grid, tuple(mi.Float(s) for s in raymarch.default_steps(2 / 384)))
    x, d = arrays([[-0.3, 0.0, 0.9], [-0.3, 0.0, 0.9]]), arrays([[0, 0, -1.0], [0, 0, -1.0]])
    tau = np.array(march.tau(x, d, mi.Float([0.4, 1.0]), mi.UInt32(0), dr.full(mi.Bool, True, 2)))
    assert tau[0] > 0.95 and tau[1] < 1e-3


def test_baseline_without_its_network_is_refused(network):
    with pytest.raises(MiNtfError, match="no visibility network; train it with `mi-ntf train --visibility-mlp`"):
        VisibilityMLP(network)


class Slab:
    """Stand-in for a field: τ falls with the place along x, independently of the distance."""

    has_visibility = True

    def visibility(self, p, d):
        return 0.5 + 0.25 * p[0] * d[0] + 0.25 * p[1] * d[1]


def test_baseline_asks_where_the_ray_is_inside_the_sphere():
    """Points inside are queried in place, points before the sphere where the ray enters, points behind not at all."""
    visibility = VisibilityMLP(Slab())
    x = arrays([[0.2, 0.0, 0.0], [-3.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 2.0], [-3.0, 0.0, 0.0]])
    distance = mi.Float([np.inf, np.inf, np.inf, np.inf, 1.5])
    tau = np.array(visibility.tau(x, arrays(np.tile([1.0, 0, 0], (5, 1))), distance, mi.UInt32(0), True))
    np.testing.assert_allclose(tau, [0.55, 0.25, 1, 1, 1], atol=1e-6)


def test_baseline_between_points_and_lights_that_touch_the_sphere(rng):
    """Nothing is in the way, whatever the rounding."""
    on = rng.normal(size=(500, 3))
    on /= np.linalg.norm(on, axis=1, keepdims=True)
    outward = on + 0.3 * rng.normal(size=on.shape)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    below = VisibilityMLP(Slab()).tau(arrays(on), arrays(-outward), mi.Float(np.inf), mi.UInt32(0), True)
    assert (np.array(below) < 1).all()
    for x, d, distance in ((on, outward, np.inf), (on + 0.5 * outward, -outward, 0.5)):
        tau = VisibilityMLP(Slab()).tau(arrays(x), arrays(d), mi.Float(np.float32(distance)), mi.UInt32(0), True)
        np.testing.assert_array_equal(np.array(tau), 1)
