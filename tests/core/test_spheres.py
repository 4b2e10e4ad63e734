"""Two-sphere rays: invariants over random lines, a slow oracle, and the float32 behaviour far from the sphere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_ntf.core import ops, spheres

unit = st.floats(-1, 1, allow_subnormal=False)


def _direction(z, phi):
    r = np.sqrt(1 - z * z)
    return np.array([r * np.cos(phi), r * np.sin(phi), z])


directions = st.builds(_direction, unit, st.floats(0, 2 * np.pi))
near_points = st.tuples(unit, unit, unit).map(np.array)


def _chord(o, d, dtype=np.float64):
    hit, m, h = spheres.chord(ops, tuple(np.asarray(o, dtype)), tuple(np.asarray(d, dtype)))
    return bool(hit), np.array(m), float(h)


@given(near_points, directions)
def test_chord_meets_the_sphere_and_its_midpoint_is_perpendicular(o, d):
    hit, m, h = _chord(o, d)
    assert abs(m @ d) < 1e-14  # two projections in float64
    np.testing.assert_allclose(np.cross(m - o, d), 0, atol=1e-14)  # m lies on the line
    b = o @ d
    disc = b * b - (o @ o - 1)  # method.md, section 3, as printed
    assert hit == (disc > spheres.MIN_HALF_CHORD**2) or abs(disc - spheres.MIN_HALF_CHORD**2) < 1e-13
    if hit:
        assert h == pytest.approx(np.sqrt(disc), abs=1e-12)  # the printed form cancels: 1e-16/h
        for p in spheres.end_points(tuple(m), tuple(d), h):
            assert np.linalg.norm(p) == pytest.approx(1, abs=1e-14)


@given(near_points, directions)
def test_reversal_swaps_the_end_points_and_negates_t(o, d):
    hit, m, h = _chord(o, d)
    hit_r, m_r, h_r = _chord(o, -d)
    assert hit == hit_r and h == pytest.approx(h_r, abs=1e-15)
    p1, p2 = spheres.end_points(tuple(m), tuple(d), h)
    q1, q2 = spheres.end_points(tuple(m_r), tuple(-d), h_r)
    np.testing.assert_allclose([p1, p2], [q2, q1], atol=1e-15)
    assert spheres.coordinate(tuple(o), tuple(d)) == -spheres.coordinate(tuple(o), tuple(-d))


@given(near_points, directions, st.floats(-5, 5))
def test_t_is_the_inner_product_with_the_direction(o, d, s):
    x = o + s * d
    _, m, _ = _chord(o, d)
    # t' is by definition the signed distance from the midpoint along d; the inner product must agree.
    t = spheres.coordinate(tuple(x), tuple(d))
    np.testing.assert_allclose(m + t * d, x, atol=1e-14)
    assert t - spheres.coordinate(tuple(o), tuple(d)) == pytest.approx(s, abs=1e-14)


@given(near_points, directions, st.floats(-1e3, 1e3))
def test_chord_does_not_depend_on_the_origin_of_the_line(o, d, s):
    _, m, h = _chord(o, d)
    _, m2, h2 = _chord(o + s * d, d)
    np.testing.assert_allclose(m2, m, atol=1e-12)  # 1e3 · eps
    if h > 2 * spheres.MIN_HALF_CHORD:
        assert h2 == pytest.approx(h, abs=1e-11)


@pytest.mark.parametrize("distance", [1.0, 30.0, 1000.0])
def test_float32_error_grows_with_the_distance_and_no_faster(distance):
    rng = np.random.default_rng(1)
    d = rng.normal(size=(20000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = rng.uniform(-0.5, 0.5, (20000, 3)) - distance * d
    d32, o32 = d.astype(np.float32), o.astype(np.float32)
    _, m, h = spheres.chord(ops, tuple(o32.T), tuple(d32.T))
    d64, o64 = d32.astype(float), o32.astype(float)
    d64 /= np.linalg.norm(d64, axis=1, keepdims=True)
    _, m64, h64 = spheres.chord(ops, tuple(o64.T), tuple(d64.T))
    # One rounding of each product b·d, components up to `distance`: 6e-8 each, three of them, both ways.
    error = np.abs(np.array(m) - np.array(m64)).max()
    assert error < 4e-7 * distance
    assert np.array(m).dtype == np.float32
    assert np.abs(np.sum(np.array(m) * d32.T, axis=0)).max() < 3e-7  # the second projection, whatever the distance
    deep = h64 > 0.5
    assert np.abs(h - h64)[deep].max() < 1.2e-6 * distance  # dh = m·dm/h, |m|/h < 2 there


def test_lines_that_miss_or_graze_have_finite_results():
    d = (np.zeros(5), np.zeros(5), np.ones(5))
    x = np.array([0.0, 1.0, 1.0 - 1e-12, np.sqrt(1 - 0.0499**2), 50.0])
    hit, m, h = spheres.chord(ops, (x, 0 * x, 3 + 0 * x), d)
    assert hit.tolist() == [True, False, False, False, False]
    np.testing.assert_allclose(h, [1, 0.05, 0.05, 0.05, 0.05])
    assert np.isfinite(m).all()


def test_lattice_is_spread_evenly():
    d = spheres.fibonacci(50)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-12)
    assert np.abs(d.mean(0)).max() < 0.02  # its points balance each other
    assert (d @ d.T - 2 * np.eye(50)).max() < np.cos(0.3)  # 50 caps of equal area have a radius of 0.28
