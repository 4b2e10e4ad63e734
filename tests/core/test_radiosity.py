"""Patches, their rays, and the light between them, against closed forms and a dense linear solve."""

import numpy as np
import pytest

from mi_ntf.core import radiosity


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_directions_have_the_density_of_a_cosine(rng):
    normals = unit(rng.normal(size=(500, 3)))
    d = radiosity.directions(normals, 8, rng)
    cos = np.einsum("ij,ikj->ik", normals, d)
    np.testing.assert_allclose(np.linalg.norm(d, axis=2), 1, rtol=1e-12)
    assert d.shape == (500, 64, 3) and cos.min() >= 0
    # ∫ cos^k cos/π dω = 2/(k + 2); 32 000 stratified samples.
    for k in (1, 2, 4):
        assert (cos**k).mean() == pytest.approx(2 / (k + 2), abs=1e-3)
    # No side is preferred: the mean direction is 2/3 of the normal.
    np.testing.assert_allclose(d.mean(1), 2 / 3 * normals, atol=0.1)


def test_rays_begin_above_their_own_patch(rng):
    points, normals = rng.uniform(-0.5, 0.5, (20, 3)), unit(rng.normal(size=(20, 3)))
    o, d = radiosity.rays(points, normals, 3, rng)
    patch = np.repeat(np.arange(20), 9)
    np.testing.assert_allclose(o, points[patch] + radiosity.RISE * normals[patch], rtol=1e-12)
    assert ((normals[patch] * d).sum(1) > 0).all()


def test_a_table_knows_its_patches_and_both_sides_of_a_sheet(rng):
    points = np.concatenate([rng.uniform(-0.5, 0.5, (2000, 2)).T, rng.uniform(-0.002, 0.002, (1, 2000)) + 0.01]).T
    normals = np.where(np.arange(2000)[:, None] % 2, [0, 0.1, 1], [0.1, 0, -1.0])
    remaining = radiosity.thin(points, normals)
    points, normals = points[remaining], normals[remaining]
    table = radiosity.table(points, normals)
    np.testing.assert_array_equal(table[radiosity.place(points, normals)], np.arange(len(remaining)))
    inside = (np.abs(points[:, :2]) < 0.45).all(1)
    above = table[radiosity.place(points[inside] + [0, 0, 0.04], np.tile([0, 0, 1.0], (inside.sum(), 1)))]
    assert (normals[above][:, 2] > 0).all()
    # A normal along the sheet finds one of the two, and far away there is nothing.
    assert (table[radiosity.place(points[inside], np.tile([1.0, 0, 0], (inside.sum(), 1)))] >= 0).all()
    assert (table[:, 0] == -1).all()


def test_solve_is_the_linear_system(rng):
    """The light between patches solves (1 − F K) E = F K D, F the fractions of rays."""
    n, rays = 40, 30
    hits = rng.integers(-1, n, (n, rays))
    shares = np.stack([(hits == j).mean(1) for j in range(n)], 1)
    albedo, direct = rng.uniform(0, 0.9, (n, 3)), rng.uniform(0, 5, (n, 3))
    actual = radiosity.solve(hits, albedo, direct, -1)
    for c in range(3):
        exact = np.linalg.solve(np.eye(n) - shares * albedo[:, c], shares @ (albedo[:, c] * direct[:, c]))
        # The last change was below 1e-3, and what follows is a geometric series of ratio 0.9 at most.
        np.testing.assert_allclose(actual[:, c], exact, atol=1e-2 * exact.max())
    once = radiosity.solve(hits, albedo, direct, 1)
    np.testing.assert_allclose(once, shares @ (albedo * direct), rtol=1e-12)
    assert not radiosity.solve(hits, albedo, direct, 0).any()


def test_a_closed_box_gathers_the_geometric_series():
    """E = D/(1 − k) if every ray meets a patch of the same light."""
    hits = np.zeros((5, 4), int)
    direct = np.ones((5, 3))
    actual = radiosity.solve(hits, np.full((5, 3), 0.5), direct, -1)
    np.testing.assert_allclose(direct + actual, 2, rtol=2e-3)  # ends when a bounce adds less than 1e-3


def test_no_patches_send_no_light():
    nothing = np.zeros((0, 3))
    assert (radiosity.table(nothing, nothing) == -1).all() and not len(radiosity.thin(nothing, nothing))
    assert radiosity.solve(np.zeros((0, 4), int), nothing, nothing, -1).shape == (0, 3)
