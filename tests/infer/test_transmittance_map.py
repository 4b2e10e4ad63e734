"""Transmittance maps against their rays."""

import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields
from helpers.jit import arrays
from helpers.variants import VARIANT

from mi_ntf.core import logistic, mixture, ops
from mi_ntf.infer.grid import baked
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.profile import DepthProfile
from mi_ntf.infer.visibility.light_rays import COLUMNS, DIRECTIONAL, FRUSTUM, KIND, SPHERE, LightRays, frames
from mi_ntf.infer.visibility.map_source import CLEAR, Source, field_source, network_source
from mi_ntf.infer.visibility.method import resolution_for
from mi_ntf.infer.visibility.ray_network import RayNetwork
from mi_ntf.infer.visibility.raymarch import optical_depth
from mi_ntf.infer.visibility.transmittance_map import TransmittanceMap

LIGHTS = {
    "sun": (np.array([0.48, 0.6, 0.64]), False),
    "lamp": (np.array([1.5, 1.0, 2.0]), True),
    "far": (np.array([4800.0, 6000.0, -6400.0]), True),
    "on the sphere": (np.array([0.0, 0.6, 0.8]), True),
    "inside": (np.array([0.1, 0.5, -0.15]), True),
}
NEAR = ("inside",)


def table(*names):
    where, is_point = zip(*(LIGHTS[n] for n in names), strict=True)
    return LightTable(np.array(where), np.ones((len(names), 3)), np.array(is_point), 1.0, mi)


def towards(x, name):
    """Unit vectors to the light and distances."""
    where, point = LIGHTS[name]
    d = (where - x) if point else np.broadcast_to(where, x.shape)
    r = np.linalg.norm(d, axis=1)
    return d / r[:, None], r if point else np.full(len(x), np.inf)


def look(visibility, x, name, index=0):
    wi, distance = towards(x, name)
    return np.array(visibility.tau(arrays(x), arrays(wi), mi.Float(distance), mi.UInt32(index), True))


def marched(grid, x, name):
    wi, distance = towards(x, name)
    steps = tuple(mi.Float(s) for s in (1 / 512, 1 / 512, 0.1))
    depth = optical_depth(
        grid, arrays(x), arrays(wi), mi.Float(distance), steps, dr.full(mi.Bool, True, len(x))
    )
    return np.exp(-np.array(depth))


def analytic_source(a, b_of):
    """Return a source whose (a, b) are a known smooth function of the ray, to test the map without any fit."""

    def fit(o, d, end):
        return ((1.0, dr.full(mi.Float, a, dr.width(d[0])), b_of(o, d)),)

    return Source(fit, 1, False)


def random_rays(rays, index, rng, count=300):
    """Return ``(o, d, end)`` of rays through random texel centres away from the table's edges, NumPy."""
    light = rays.light(mi.UInt32(index), True)
    cells = [np.floor(rng.uniform(2, float(np.array(n).ravel()[0]) - 2, count)) for n in (light.columns,
                                                                                         rays.lines(light))]
    o, d, end = rays.ray(light, *(mi.Float(c.astype(np.float32)) for c in cells))
    o, d = (np.array([np.broadcast_to(np.array(c, np.float64), count) for c in v]) for v in (o, d))
    return o, d, np.broadcast_to(np.array(end, np.float64), count)


@pytest.mark.parametrize("source", ["network", "field", "mixture"])
@pytest.mark.parametrize("name", LIGHTS)
def test_texel_centre_returns_its_own_ray(grid, network, reader, name, source, rng):
    """A point on a texel's ray sees that ray's own mixture, exactly."""
    fitted = {"network": lambda: network_source(network, reader), "field": lambda: field_source(grid, reader),
              "mixture": lambda: field_source(grid, reader, 2)}[source]()
    tmap = TransmittanceMap(table(name), 32, grid.hull, fitted, mi)
    o, d, end = random_rays(tmap.rays, 0, rng)
    where = np.minimum(rng.uniform(-0.4, 0.4, 300), end - 0.02)
    x = (o + (where - (o * d).sum(0)) * d).T
    mix = fitted.fit(arrays(o.T), arrays(d.T), mi.Float(np.minimum(end, 1e30)))
    mix = [[np.array(v, np.float64) for v in part] for part in mix]
    truth = np.minimum(mixture.transmittance(ops, where, mix), 1)
    # float32 texel coordinates: 1e-5 of a texel, times neighbours that differ by at most 1; slopes of a·1e-6.
    np.testing.assert_allclose(look(tmap, x, name), truth, atol=3e-3)


@pytest.mark.parametrize("name", LIGHTS)
def test_places_on_the_rays_around_a_point(grid, name, rng):
    """The plane through a point across its light's direction cuts the four nearest rays there, also in large cells."""
    rays = LightRays(table(name), grid.hull, 12, mi)
    x = rng.uniform(-0.25, 0.25, (500, 3))
    wi, distance = towards(x, name)
    inside, _, actual = rays.nearest(mi.UInt32(0), arrays(x), arrays(wi), mi.Float(distance), True)
    assert np.array(inside).all()
    o, d = (np.array([np.broadcast_to(np.array(c, np.float64), 144) for c in v]).T for v in rays.all_rays(0, 1)[1:3])
    np.testing.assert_allclose(sum(np.array(weight) for weight, _, _ in actual), 1, atol=1e-5)
    for _, texel, t in actual:
        start, along = o[np.array(texel)], d[np.array(texel)]
        truth = (start * along).sum(1) + ((x - start) * wi).sum(1) / (along * wi).sum(1)
        np.testing.assert_allclose(np.array(t), truth, atol=1e-5)


@pytest.mark.parametrize("name", LIGHTS)
def test_interpolation_reproduces_a_smooth_map(grid, name, rng):
    """b linear in the ray's place and a = 5: bilinear τ differs from the truth by second order in the texel only."""

    def b_of(o, d):
        m = tuple(a - (o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) * b for a, b in zip(o, d, strict=True))
        return 0.3 * m[0] - 0.2 * m[1] + 0.1

    tmap = TransmittanceMap(table(name), 64, grid.hull, analytic_source(5.0, b_of), mi)
    x = rng.uniform(-0.25, 0.25, (2000, 3))
    wi, _ = towards(x, name)
    t = (x * wi).sum(1)
    m = x - t[:, None] * wi
    truth = logistic.transmittance(ops, t, 5.0, 0.3 * m[:, 0] - 0.2 * m[:, 1] + 0.1)
    # (5·0.36)²·(texel 0.03)²/8 of S''; octahedral texels measure 0.06 rad, and creases double the error.
    np.testing.assert_allclose(look(tmap, x, name), truth, atol=6e-3 if name in NEAR else 2e-3)


@pytest.mark.parametrize("components", [1, 2])
@pytest.mark.parametrize("name", LIGHTS)
def test_field_source_matches_the_march(grid, reader, name, components, rng):
    """Maps of the field at points in the open and in shadow, wherever the light is."""
    tmap = TransmittanceMap(table(name), 256, grid.hull, field_source(grid, reader, components), mi)
    x = rng.uniform(-0.6, 0.6, (4000, 3))
    truth = marched(grid, x, name)
    error = np.abs(look(tmap, x, name) - truth)
    # Grazing rays keep a plateau that no single logistic has; they are a few per cent.
    fraction, rms = ((0.05, 0.06), (0.006, 0.02))[components - 1]
    assert np.median(error) < 2e-3 and (error > 0.1).mean() < fraction and np.sqrt((error**2).mean()) < rms
    assert 0.05 < (truth < 0.5).mean() < 0.95


@pytest.mark.parametrize("source", ["network", "mixture"])
@pytest.mark.parametrize("name", LIGHTS)
def test_transmittance_along_texel_rays(grid, network, reader, name, source, rng):
    """τ lies in [0, 1], grows towards the light and is 1 there."""
    fitted = network_source(network, reader) if source == "network" else field_source(grid, reader, 2)
    tmap = TransmittanceMap(table(name), 32, grid.hull, fitted, mi)
    o, d, end = random_rays(tmap.rays, 0, rng, 100)
    far = np.minimum(end - 1e-3, 1.0)
    steps = np.linspace(-1, 1, 40)[:, None] * (far + 1) / 2 + (far - 1) / 2
    tau = np.array([look(tmap, (o + (t - (o * d).sum(0)) * d).T, name) for t in steps])
    assert (tau >= 0).all() and (tau <= 1).all()
    # Along a ray the lookup's place in the map is the same up to rounding, 1e-5 of a texel.
    assert np.diff(tau, axis=0).min() > -3e-3
    outside = np.linalg.norm(LIGHTS[name][0]) >= 0.99 or source == "network"
    # A light inside lies in the blobs' faint rim, which takes some light within a thousandth.
    np.testing.assert_allclose(tau[-1], 1, atol=0.02 if outside else 0.05)


def test_map_covers_every_point_with_density(grid, rng):
    """No point of the object falls outside its light's window, where τ would be 1."""
    for name in LIGHTS:
        blocked = analytic_source(1.0, lambda o, d: dr.full(mi.Float, 90.0, dr.width(d[0])))
        tmap = TransmittanceMap(table(name), 16, grid.hull, blocked, mi)
        x = rng.uniform(-1, 1, (100000, 3))
        x = x[np.array(grid.density(arrays(x))) > 0]
        assert look(tmap, x, name).max() < 1e-6


def test_texels_are_square_and_no_more_than_asked_for(grid):
    """Texels are square also on an oblong object, where m × m texels would be oblong and half of them wasted."""
    tall = grid.hull * [0.3, 1.0, 0.3]
    for name in ("sun", "lamp", "far"):
        (row,) = frames(table(name), tall, 64)
        columns = row[COLUMNS]
        lines = np.floor((64**2 + 0.5) / columns)
        assert 0.95 * 64**2 < columns * lines <= 64**2
        assert np.linalg.norm(row[:3]) / np.linalg.norm(row[4:7]) == pytest.approx(1, abs=0.06)  # whole texels
        assert not 0.6 < columns / lines < 1.6


def test_lights_near_the_object_look_everywhere(grid):
    """Lights have a frustum if it covers the object, and all directions if they are near or inside."""
    kinds = frames(table(*LIGHTS), grid.hull, 32)[:, KIND]
    np.testing.assert_array_equal(kinds, [DIRECTIONAL, FRUSTUM, FRUSTUM, FRUSTUM, SPHERE])


def test_outside_and_clear_rays_are_lit(grid, reader):
    tmap = TransmittanceMap(table("sun"), 16, grid.hull, field_source(grid, reader), mi)
    b = np.array(tmap.values)[1::2]
    assert (b == CLEAR).any() and (b > -1.5).any()
    assert look(tmap, np.array([[0.0, 0.9, -0.9]]), "sun") == 1


def test_many_lights_each_get_their_own_map(grid, network, reader, rng):
    """Light k of a table of many has the map of the same light alone."""
    fitted = network_source(network, reader)
    together = TransmittanceMap(table(*LIGHTS), 24, grid.hull, fitted, mi)
    x = rng.uniform(-0.4, 0.4, (100, 3))
    for k, name in enumerate(LIGHTS):
        alone = TransmittanceMap(table(name), 24, grid.hull, fitted, mi)
        np.testing.assert_allclose(look(together, x, name, k), look(alone, x, name), atol=1e-5)


@pytest.mark.parametrize("slope", [0.6, 3.0])
def test_slanted_skin_stays_sharp(grid, slope, rng):
    """A plane at a slant under steep logistics: read at equal depth in the skin up to a texel's difference between the
    four rays; beyond that blurred by the texel, as the paper's rule has it."""
    side = np.cross(LIGHTS["sun"][0], [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)

    def b_of(o, d):
        return slope * (o[0] * side[0] + o[1] * side[1] + o[2] * side[2])

    tmap = TransmittanceMap(table("sun"), 64, grid.hull, analytic_source(100.0, b_of), mi)
    x = rng.uniform(-0.25, 0.25, (4000, 3))
    b = slope * (x @ side)
    x += (b + rng.uniform(-0.05, 0.05, 4000) - x @ LIGHTS["sun"][0])[:, None] * LIGHTS["sun"][0]
    truth = logistic.transmittance(ops, x @ LIGHTS["sun"][0], 100.0, slope * (x @ side))
    error = np.abs(look(tmap, x, "sun") - truth).max()
    assert error < 2e-3 if slope < 1 else 0.02 < error < 0.3


@pytest.mark.parametrize("components", [1, 2])
def test_light_deep_in_opaque_matter(components, rng):
    """The network's τ at the light has underflowed; the map is still 1 there and e^−(difference of depths) beyond, as
    in one query a point, and no light that leaks out of the matter."""
    header, tensors = fields.blobs([(0, 0, 0)], [0.5], log_density=5.5, components=components)
    for name, values in tensors.items():
        if name.startswith("transmittance"):
            values *= 0.2
    network = NetworkField(header, tensors, mi)
    grid = baked(network, 48, mi)
    reader = DepthProfile(grid, mi.Float(1 / 512))
    where = np.array([[0.05, -0.1, 0.02]])
    lights = LightTable(where, np.ones((1, 3)), np.array([True]), 1.0, mi)
    whole = lambda o, d, begin=None: reader(o, d)  # noqa: E731 — the light lies on a ray the network knows whole
    tmap = TransmittanceMap(lights, 32, grid.hull, network_source(network, whole), mi)
    o, d, _ = random_rays(tmap.rays, 0, rng)
    distance = np.concatenate([np.full(100, 3e-4), rng.uniform(3e-4, 0.02, 100), rng.uniform(0.4, 0.9, 100)])
    x = (o - distance * d).T
    wi, r = (where - x) / distance[:, None], mi.Float(distance)
    truth = np.array(RayNetwork(network, whole).tau(arrays(x), arrays(wi), r, mi.UInt32(0), True))
    actual = np.array(tmap.tau(arrays(x), arrays(wi), r, mi.UInt32(0), True))
    # Slopes of some hundred times float32's 1e-6; where S = e^−8 stands for an exponential, 3e-4 of it.
    np.testing.assert_allclose(actual, truth, atol=3e-3)
    assert actual[200:].max() < 1e-5 and 0.01 < truth[100:200].mean() < 0.99


ALONE = """
import sys
import drjit as dr, mitsuba as mi, numpy as np
mi.set_variant(sys.argv[1])
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.visibility.light_rays import LightRays
table = LightTable([[0.0, 1.0, 2.0]], np.ones((1, 3)), [True], 1.0, mi)
"""


@pytest.mark.parametrize("resolution", [5, 7, 9, 31])
def test_tables_of_any_size(grid, resolution, rng):
    """The number of texels need not be a multiple of a processor's lanes.

    Lanes past the end belong to no light and must not divide by the memory behind the last one."""
    program = f"{ALONE}\ndr.eval(LightRays(table, np.eye(3), {resolution}, mi).all_rays(0, 1)); dr.sync_thread()"
    subprocess.run([sys.executable, "-c", program, VARIANT], check=True)
    names = [n for n in LIGHTS if n != "inside"]
    several = LightRays(table(*names), grid.hull, resolution, mi)
    actual = [np.array(v) for v in several.all_rays(0, len(names))[2]]
    for k, name in enumerate(names):
        alone = [np.array(v) for v in LightRays(table(name), grid.hull, resolution, mi).all_rays(0, 1)[2]]
        part = slice(k * resolution**2, (k + 1) * resolution**2)
        np.testing.assert_allclose([v[part] for v in actual], alone, atol=1e-6)


def test_default_resolution_shares_the_texels_of_a_few_fine_maps():
    """Few lights have texels as fine as the voxels, and more lights share as many texels, but at least 192 a side."""
    assert [resolution_for(lights, 384) for lights in (0, 1, 8, 16)] == [384] * 4
    assert [resolution_for(lights, 384) for lights in (32, 64, 512)] == [271, 192, 192]
    assert [resolution_for(lights, 192) for lights in (1, 512)] == [192, 192]
