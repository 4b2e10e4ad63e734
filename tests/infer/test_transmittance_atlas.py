"""The transmittance atlas against closed forms and fine marches."""

import functools
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, hard_cases

from mi_ntf.core import field_file
from mi_ntf.infer import octahedral, texels, tuning
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.visibility import outside, raymarch, transmittance_atlas
from mi_ntf.infer.visibility.marched_suns import MarchedSuns
from mi_ntf.infer.visibility.method import Options
from mi_ntf.render.maps import building

SCENES = Path(__file__).parents[2] / "scenes"


def unit(n: int, seed: int) -> np.ndarray:
    """(3, n) directions."""
    d = np.random.default_rng(seed).normal(size=(3, n))
    return d / np.linalg.norm(d, axis=0)


def lanes(values: np.ndarray) -> tuple:
    return tuple(mi.Float(c) for c in values.astype(np.float32))


def tau(method, x: np.ndarray, d: np.ndarray, distance=np.inf, look=None) -> np.ndarray:
    look = look or (lambda *about: method.tau(*about))
    far = dr.full(mi.Float, float(distance), x.shape[1])
    return np.array(look(lanes(x), lanes(d), far, mi.UInt32(0), mi.Bool(True)))


def test_cells_and_directions(variant):
    """Every centre lies in its own cell; the neighbour across an edge is the nearest direction."""
    side = mi.Float(8)
    v, u = (c.ravel().astype(np.float32) for c in np.mgrid[:8, :8])
    d = octahedral.direction(mi.Float(u), mi.Float(v), side)
    np.testing.assert_allclose(np.linalg.norm(np.array(d), axis=0), 1, rtol=1e-6)
    actual = octahedral.place(d, side)
    np.testing.assert_allclose(actual[0], u, atol=1e-5)
    np.testing.assert_allclose(actual[1], v, atol=1e-5)
    for tu, tv, wu, wv in ((-1, 2, 0, 5), (8, 2, 7, 5), (2, -1, 5, 0), (2, 8, 5, 7), (3, 3, 3, 3)):
        beyond = octahedral.wrap(mi.Float(tu), mi.Float(tv), side)
        assert (float(beyond[0][0]), float(beyond[1][0])) == (wu, wv)


@pytest.fixture
def statue(variant):
    return captured()


@functools.cache
def captured():
    medium = hard_cases.baked(*field_file.load(SCENES / "statue" / "field.safetensors"), resolution=384)
    return medium, building.build("transmittance_atlas", medium, None, Options(2 / building.samples(medium)))


def skin(medium, n: int, seed: int) -> np.ndarray:
    """Return points (3, n) halfway through the skin that random rays meet first, for most rays."""
    d = unit(n, seed)
    o = -2 * d + 0.3 * unit(n, seed + 1)
    t = np.full(n, 1.0)
    depth = np.zeros(n)
    for _ in range(500):
        sigma = np.array(medium.source.density(lanes(o + t * d)))
        depth += sigma * 0.004
        t += np.where(depth < 0.7, 0.004, 0)
    return (o + t * d)[:, depth >= 0.7]


def test_close_to_marches_on_a_captured_object(statue):
    """τ of single rays errs by the width of texels and directions; the mean is right."""
    medium, atlas = statue
    x = skin(medium, 60_000, 1)
    d = unit(x.shape[1], 3)
    steps = tuple(mi.Float(s / 4) for s in raymarch.default_steps(2 / building.samples(medium)))
    truth = tau(raymarch.RayMarch(medium.source, steps), x, d)
    error = tau(atlas, x, d) - truth
    print(f"mean {error.mean() / truth.mean():+.2%}, RMS {np.sqrt((error**2).mean()):.3f}")
    assert x.shape[1] > 20_000 and 0.1 < truth.mean() < 0.6
    assert abs(error.mean()) < 0.02 * truth.mean()
    assert np.sqrt((error**2).mean()) < 0.07  # of single texels: 1.2 % and 0.058 when this was written


def test_bounded_and_made_of_the_same_bits_each_time(statue):
    _, atlas = statue
    x, d = 0.9 * unit(5000, 5), unit(5000, 6)
    first, again = (tau(atlas, x, d) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.min() >= 0 and first.max() <= 1
    reported = 4 * transmittance_atlas.numbers(captured()[0], None, Options(2 / 384))
    assert atlas.maps.texels.nbytes == reported <= 64 << 20


def test_numbers_of_half_precision(variant):
    """Rows are read as they were written, rounded to eleven bits; files hold the texture's numbers."""
    rows = np.random.default_rng(4).normal(size=(5000, 8)).astype(np.float32)
    stored = {half: texels.Texels(rows.ravel(), 5000, 8, mi, half) for half in (False, True)}
    index = dr.arange(mi.UInt32, 5000)
    for half, actual in stored.items():
        read = np.stack([np.array(c) for c in actual.row(index, mi.Bool(True))], 1)
        np.testing.assert_array_equal(read, rows.astype(actual.dtype).astype(np.float32))
        np.testing.assert_array_equal(actual.numbers(), read.ravel().astype(actual.dtype))
        assert actual.nbytes == (2 if half else 4) * rows.size
    numbers = texels.blank(5000, 8, mi)
    dr.scatter(numbers, mi.Float(rows.ravel()), dr.arange(mi.UInt32, rows.size))
    again = texels.Texels(numbers, 5000, 8, mi, True)
    # Rounded now, not by the picture that reads it first.
    assert again.texture.tensor().array.state == dr.VarState.Evaluated
    np.testing.assert_array_equal(again.numbers(), stored[True].numbers())


def test_directions_are_drawn_from_the_stream_without_bias(statue, monkeypatch):
    """The mean cell of one ray over 2¹⁶ seeds is the place of the ray among cells."""
    _, atlas = statue
    count = 1 << 16
    monkeypatch.setattr(atlas, "stream", dr.arange(mi.UInt32, count) * 977)
    for x, d in zip(0.8 * unit(12, 18).T, unit(12, 19).T, strict=True):
        ray = [tuple(mi.Float(float(c)) for c in v) for v in (x, d)]
        u = transmittance_atlas._uniforms(mi, atlas.stream, *ray)
        place = [float(f[0]) for f in octahedral.place(ray[1], mi.Float(tuning.ATLAS_SIDE))]
        for f, sampled in ((place[0], u[0]), (place[1], u[1]), (0.3, u[2]), (0.7, u[3]), (0.5, u[4])):
            mean = np.floor(f + np.array(sampled, np.float64)).mean()
            fraction = f - np.floor(f)
            assert abs(mean - f) < 4.5 * np.sqrt(fraction * (1 - fraction) / count) + 2.0**-16  # 60 z-tests
        assert abs(np.corrcoef(np.array(u, np.float64)) - np.eye(5)).max() < 4.5 / np.sqrt(count)


def test_points_outside_see_the_object(statue):
    """Points on a sphere of twice the radius: τ is 1 for rays that miss and 0 through the middle; the mean is right."""
    medium, atlas = statue
    d = unit(40_000, 7)
    x = -2 * d + 0.7 * unit(40_000, 8)
    march = building.build("raymarch", medium, None, Options(2 / 384))
    actual, truth = (tau(m, x, d, look=lambda *about, m=m: outside.tau(m, *about)) for m in (atlas, march))
    assert abs(actual.mean() - truth.mean()) < 0.01
    print(f"outside: mean {actual.mean() - truth.mean():+.4f}, RMS {np.sqrt(((actual - truth) ** 2).mean()):.3f}")
    assert np.sqrt(((actual - truth) ** 2).mean()) < 0.22  # either side of outlines, a texel and a direction wide


def test_lights_inside_are_marched(statue, monkeypatch):
    """Lights inside are marched even if the light table has none: sampled lights use the same atlas."""
    medium, atlas = statue
    x, d = 0.3 * unit(3000, 9), unit(3000, 10)
    expected = tau(building.build("raymarch", medium, None, Options(2 / building.samples(medium))), x, d, 0.3)
    np.testing.assert_array_equal(tau(atlas, x, d, 0.3), expected)
    monkeypatch.setattr(tuning, "ATLAS_SIDE", 4)
    monkeypatch.setattr(tuning, "ATLAS_RESOLUTION", 8)
    sun = LightTable(np.array([[0.6, 0.0, 0.8]]), np.ones((1, 3)), np.array([False]), 1.0, mi)
    shared = building.build("transmittance_atlas", medium, sun, Options(2 / building.samples(medium)))
    np.testing.assert_array_equal(tau(shared, x, d, 0.3), expected)


def test_depth_close_by_is_right_on_average(variant):
    """Mean of 4,096 estimates for exponentials and logistics of any width, from thin to thick."""
    v = (dr.arange(mi.Float, 4096) + 0.5) / 4096
    x, wi = (tuple(mi.Float(c) for c in p) for p in ((0.0, 0.0, 0.0), (0.0, 0.6, 0.8)))
    t = np.linspace(0, tuning.REACH, 20_001)
    deviation = []
    for width in np.geomspace(0.002, 0.06, 20):
        for start in (None, 1.0, 2.5):
            def shape(t, width=width, start=start, exp=np.exp):
                return exp(-t / width) if start is None else 1 / (1 + exp(t / width - start))

            for depth in (0.2, 1.0, 3.0):
                top = depth / np.trapezoid(shape(t), t)

                def density(p, top=top, shape=shape):
                    return top * shape(p[1] / 0.6, exp=dr.exp)

                actual = np.array(transmittance_atlas.close_by(density, x, wi, v, 4), np.float64)
                np.testing.assert_allclose(-np.log(actual).mean(), depth, rtol=2e-3)
                deviation.append(actual.mean() - np.exp(-depth))
    print(f"RMS {np.sqrt(np.mean(np.square(deviation))):.4f}, most {np.abs(deviation).max():.4f}")
    assert np.sqrt(np.mean(np.square(deviation))) < 0.003 and np.abs(deviation).max() < 0.02


def test_nothing_blocks_in_an_empty_field(variant):
    medium = hard_cases.baked(*fields.uniform(1e-4), 64)
    atlas = building.build("transmittance_atlas", medium, None, Options(2 / 384))
    np.testing.assert_allclose(tau(atlas, 0.8 * unit(2000, 11), unit(2000, 12)), 1, atol=2e-3)


def test_even_smoke(variant):
    """e^(−σ·way) through a ball of σ = 1: the error of the fit is bounded, and the mean is right."""
    medium = hard_cases.baked(*fields.uniform(1.0), 64)
    atlas = building.build("transmittance_atlas", medium, None, Options(2 / 384))
    x, d = 0.7 * unit(20_000, 13) * np.random.default_rng(14).random(20_000) ** (1 / 3), unit(20_000, 15)
    march = building.build("raymarch", medium, None, Options(2 / 384))
    actual, truth = tau(atlas, x, d), tau(march, x, d)
    print(f"mean {actual.mean() / truth.mean() - 1:+.2%}, RMS {np.sqrt(((actual - truth) ** 2).mean()):.3f}")
    assert abs(actual.mean() / truth.mean() - 1) < 0.03 and np.abs(actual - truth).max() < 0.15


def test_filled_by_the_network(statue):
    """The atlas of `map_source=network` follows the ray network."""
    medium, march = statue
    assert "map_source" in transmittance_atlas.METHOD.dials
    learned = building.build("transmittance_atlas", medium, None, Options(2 / 384, map_source="network"))
    x = skin(medium, 20_000, 16)
    d = unit(x.shape[1], 17)
    assert abs(tau(learned, x, d).mean() - tau(march, x, d).mean()) < 0.02
    remembered = building.build("neural_transmittance", medium, None, Options(2 / 384))
    np.testing.assert_array_equal(tau(remembered, x, d), tau(learned, x, d))


def test_suns_are_marched(statue):
    """Suns are marched, other lights are looked up, and unlit points do neither."""
    medium, atlas = statue
    march = building.build("raymarch", medium, None, Options(2 / 384))
    both = MarchedSuns(atlas, march, np.array([False, True, False]), mi)
    x, d = skin(medium, 3000, 11), unit(3000, 12)
    d = d[:, : x.shape[1]]
    for light, method in ((0, atlas), (1, march), (2, atlas)):
        here = lanes(x), lanes(d), mi.Float(np.inf), mi.UInt32(light)
        lit = mi.Bool(np.arange(x.shape[1]) % 3 > 0)
        actual, expected = (np.where(np.array(lit), np.array(m.tau(*here, lit)), 0) for m in (both, method))
        np.testing.assert_array_equal(actual, expected)
