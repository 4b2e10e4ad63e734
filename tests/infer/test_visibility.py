"""Transmittance maps and the ray network's lookup against the rays themselves."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields

from mi_ntf.core import logistic, mixture, ops
from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.grid import GridField
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.march import optical_depth
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.profile import DepthProfile
from mi_ntf.infer.visibility import raymarch
from mi_ntf.infer.visibility.neural_transmittance import NeuralTransmittance
from mi_ntf.infer.visibility.transmittance_map import CLEAR, TransmittanceMap, field_source, network_source

BLOBS = [(-0.3, 0.0, 0.0), (0.35, 0.2, 0.1), (0.0, -0.45, 0.3)], [0.4, 0.25, 0.2]
SUN = np.array([0.48, 0.6, 0.64])
LAMP = np.array([1.5, 1.0, 2.0])


def arrays(points):
    return tuple(mi.Float(np.ascontiguousarray(c, np.float32)) for c in np.asarray(points, np.float64).T)


@pytest.fixture(scope="module")
def network():
    mi.set_variant("llvm_ad_rgb")
    return NetworkField(*fields.blobs(*BLOBS, log_density=4.5), mi)


@pytest.fixture(scope="module")
def grid(network):
    return GridField(network, 96, mi)


@pytest.fixture(scope="module")
def reader(grid):
    return DepthProfile(grid.density, grid, mi.Float(1 / 256))


def table(point: bool):
    return LightTable([LAMP if point else SUN], [[1, 1, 1]], [point], 1.0, mi)


def towards(x, point):
    """Unit vectors to the light and distances."""
    d = (LAMP - x) if point else np.broadcast_to(SUN, x.shape)
    r = np.linalg.norm(d, axis=1)
    return d / r[:, None], r if point else np.full(len(x), np.inf)


def analytic_source(a, b_of):
    """Rays whose (a, b) are a known smooth function of the ray, to test the map without any fit."""

    def fit(o, d):
        return ((1.0, dr.full(mi.Float, a, dr.width(d[0])), b_of(o, d)),)

    return fit, 1


@pytest.mark.parametrize("point", [False, True], ids=["directional", "point"])
def test_texel_centre_returns_its_own_ray(grid, network, reader, point, rng):
    """A point on a texel's ray sees that ray's own logistic, exactly."""
    lights = table(point)
    tmap = TransmittanceMap(lights, 32, grid.hull, network_source(network, reader), mi)
    light = tmap._light(mi.UInt32(0), True)
    texel = rng.integers(4, 28, (300, 2))
    origin, d = tmap._ray(light, *(mi.Float(c.astype(np.float32)) for c in texel.T))
    origin, d = (np.array(v, np.float64) for v in ([np.broadcast_to(np.array(c), 300) for c in w] for w in (origin, d)))
    where = rng.uniform(-0.4, 0.4, 300)
    x = (origin + (where - (origin * d).sum(0)) * d).T
    hit, _, mix = network.ray_mixture(arrays(x), arrays(d.T), reader)
    mix = [[np.array(v, np.float64) for v in part] for part in mix]
    truth = np.where(np.array(hit), mixture.transmittance(ops, where, mix), 1)
    wi, distance = towards(x, point)
    ours = np.array(tmap.tau(arrays(x), arrays(wi), mi.Float(distance), mi.UInt32(0), True))
    # float32 texel coordinates: 1e-5 of a texel, times neighbours that differ by at most 1; slopes of a·1e-6.
    np.testing.assert_allclose(ours, truth, atol=2e-3)


@pytest.mark.parametrize("point", [False, True], ids=["directional", "point"])
def test_interpolation_reproduces_a_smooth_map(grid, point, rng):
    """b linear in the ray's place and a = 5: bilinear τ differs from the truth by second order in the texel only."""
    lights = table(point)

    def b_of(o, d):
        m = tuple(a - (o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) * b for a, b in zip(o, d, strict=True))
        return 0.3 * m[0] - 0.2 * m[1] + 0.1

    tmap = TransmittanceMap(lights, 64, grid.hull, analytic_source(5.0, b_of), mi)
    x = rng.uniform(-0.3, 0.3, (2000, 3))
    wi, distance = towards(x, point)
    t = (x * wi).sum(1)
    m = x - t[:, None] * wi
    truth = logistic.transmittance(ops, t, 5.0, 0.3 * m[:, 0] - 0.2 * m[:, 1] + 0.1)
    ours = np.array(tmap.tau(arrays(x), arrays(wi), mi.Float(distance), mi.UInt32(0), True))
    np.testing.assert_allclose(ours, truth, atol=2e-3)  # (5·0.36)²·(texel 0.03)²/8 of S''


@pytest.mark.parametrize("point", [False, True], ids=["directional", "point"])
def test_field_source_matches_the_march(grid, reader, point, rng):
    """Maps of the field at points in the open and in shadow: opaque matter, so that one logistic suffices."""
    lights = table(point)
    tmap = TransmittanceMap(lights, 256, grid.hull, field_source(reader), mi)
    x = rng.uniform(-0.6, 0.6, (4000, 3))
    wi, distance = towards(x, point)
    depth = optical_depth(
        grid.density,
        grid,
        arrays(x),
        arrays(wi),
        mi.Float(distance),
        tuple(mi.Float(s) for s in (1 / 512, 1 / 512, 0.1)),
        dr.full(mi.Bool, True, 4000),
    )
    truth = np.exp(-np.array(depth))
    ours = np.array(tmap.tau(arrays(x), arrays(wi), mi.Float(distance), mi.UInt32(0), True))
    error = np.abs(ours - truth)
    # Grazing rays keep a plateau that no logistic has; they are a few per cent.
    assert np.median(error) < 2e-3 and (error > 0.1).mean() < 0.05 and np.sqrt((error**2).mean()) < 0.06
    assert 0.1 < (truth < 0.5).mean() < 0.9


def test_map_covers_every_point_with_density(grid, rng):
    """No point of the object falls outside its light's window, where τ would be 1."""
    for lights in (table(False), table(True)):
        blocked = analytic_source(1.0, lambda o, d: dr.full(mi.Float, 90.0, dr.width(d[0])))
        tmap = TransmittanceMap(lights, 16, grid.hull, blocked, mi)
        x = rng.uniform(-1, 1, (100000, 3))
        x = x[np.array(grid.density(arrays(x))) > 0]
        wi, distance = towards(x, bool(lights.is_point[0]))
        assert np.array(tmap.tau(arrays(x), arrays(wi), mi.Float(distance), mi.UInt32(0), True)).max() < 1e-6


def test_texels_are_square_and_no_more_than_asked_for(grid):
    """A map of m × m texels on an oblong object has oblong texels, which waste half of them."""
    tall = grid.hull * [0.3, 1.0, 0.3]
    for lights in (table(False), table(True)):
        tmap = TransmittanceMap(lights, 64, tall, analytic_source(1.0, lambda o, d: o[0]), mi)
        _, _, _, _, window, _, columns = (np.array(v) for v in tmap._light(mi.UInt32(0), True))
        lines = np.array(tmap._lines(mi.Float(columns)))
        assert 0.95 * 64**2 < columns[0] * lines[0] <= 64**2
        assert (window[2] / columns) / (window[3] / lines) == pytest.approx(1, abs=0.06)  # whole texels of 30 or more
        assert window[2] / window[3] > 1.5 or window[3] / window[2] > 1.5


def test_outside_and_clear_rays_are_lit(grid, reader):
    tmap = TransmittanceMap(table(False), 16, grid.hull, field_source(reader), mi)
    b = np.array(tmap.texture.tensor())[..., 1]
    assert (b == CLEAR).any() and (b > -1.5).any()
    far = arrays([[0.0, 0.9, -0.9]])
    assert np.array(tmap.tau(far, arrays([SUN]), mi.Float(np.inf), mi.UInt32(0), True)) == 1


def test_many_lights_each_get_their_own_map(grid, network, reader, rng):
    """Light k of a table of many equals the same light alone."""
    where = rng.normal(size=(7, 3))
    where /= np.linalg.norm(where, axis=1, keepdims=True)
    where[3:] *= 2.5
    is_point = np.arange(7) >= 3
    together = TransmittanceMap(
        LightTable(where, np.ones((7, 3)), is_point, 1.0, mi), 24, grid.hull, network_source(network, reader), mi
    )
    x = arrays(rng.uniform(-0.4, 0.4, (100, 3)))
    for k in range(7):
        single = LightTable(where[k : k + 1], np.ones((1, 3)), is_point[k : k + 1], 1.0, mi)
        alone = TransmittanceMap(single, 24, grid.hull, network_source(network, reader), mi)
        wi, _, distance = single.sample(mi.UInt32(0), x, True)
        a = together.tau(x, wi, distance, mi.UInt32(k), True)
        b = alone.tau(x, wi, distance, mi.UInt32(0), True)
        np.testing.assert_allclose(np.array(a), np.array(b), atol=1e-6)


def test_light_inside_the_object_is_refused(grid, network, reader):
    lights = LightTable([[0.2, 0.1, 0.0]], [[1, 1, 1]], [True], 1.0, mi)
    with pytest.raises(MiNtfError, match=r"point light 0 lies inside the captured object's bounding sphere \(0.224 of"):
        TransmittanceMap(lights, 16, grid.hull, network_source(network, reader), mi)


def test_neural_transmittance_is_a_transmittance(network, reader, rng):
    """In [0, 1], growing towards the light; for a light inside the sphere 1 at the light."""
    visibility = NeuralTransmittance(network, reader)
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
    """Irradiance I/r² in scene units; directional lights know no distance."""
    lights = LightTable([[0, 0, 2.0], [0, 1, 0]], [[8, 4, 2], [1, 2, 3]], [True, False], 3.0, mi)
    wi, power, distance = lights.sample(mi.UInt32([0, 1]), arrays([[0, 0, 0.5], [0.1, 0.2, 0.3]]), True)
    np.testing.assert_allclose(np.array(wi).T, [[0, 0, 1], [0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(np.array(power).T, [[8 / 20.25, 4 / 20.25, 2 / 20.25], [1, 2, 3]], rtol=1e-6)
    np.testing.assert_allclose(np.array(distance), [1.5, np.inf], rtol=1e-6)


def test_raymarch_sees_lights_inside_matter(grid):
    """The march stops at the light."""
    march = raymarch.RayMarch(grid.density, grid, tuple(mi.Float(s) for s in raymarch.default_steps(1 / 384)))
    x, d = arrays([[-0.3, 0.0, 0.9], [-0.3, 0.0, 0.9]]), arrays([[0, 0, -1.0], [0, 0, -1.0]])
    tau = np.array(march.tau(x, d, mi.Float([0.4, 1.0]), mi.UInt32(0), dr.full(mi.Bool, True, 2)))
    assert tau[0] > 0.95 and tau[1] < 1e-3
