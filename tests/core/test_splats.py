"""Gaussian splats as extinction: the closed form against numerical integrals, and the sign of normals."""

import numpy as np
import pytest
from scipy.integrate import quad

from mi_ntf.core import splat_normals
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.splats import MAX_OPACITY, Splats, density, matrices, optical_depth


def random_splats(count: int, seed: int = 0, flatness: float = 0.1) -> Splats:
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    scales = rng.uniform(0.1, 0.4, (count, 3)) * [1, 1, flatness]
    return Splats(rng.uniform(-1, 1, (count, 3)), scales, turns / np.linalg.norm(turns, axis=1, keepdims=True),
                  rng.uniform(0.1, 0.98, count), rng.uniform(0, 1, (count, 3)))


def test_optical_depth_is_the_integral_of_the_density():
    """Rays of finite length, some of which begin inside a splat."""
    splats, rng = random_splats(8), np.random.default_rng(1)
    origins, targets = rng.uniform(-1.5, 1.5, (12, 3)), rng.uniform(-0.7, 0.7, (12, 3))
    directions = (targets - origins) / np.linalg.norm(targets - origins, axis=1, keepdims=True)
    lengths = rng.uniform(0.3, 3.0, 12)
    depths = optical_depth(splats, origins, directions, lengths)
    for o, d, length, depth in zip(origins, directions, lengths, depths, strict=True):
        places = np.sort((splats.centres - o) @ d)
        integral = quad(lambda t, o=o, d=d: density(splats, (o + t * d)[None])[0], 0, length, limit=400, epsabs=1e-10,
                        points=places[(places > 0) & (places < length)])[0]
        assert depth == pytest.approx(integral, rel=1e-6, abs=1e-9)


def test_rays_through_the_centre_have_the_opacity_along_the_shortest_axis_and_more_elsewhere():
    for i in range(5):
        one = random_splats(5).take(np.array([i]))
        rng = np.random.default_rng(i)
        directions = np.concatenate([one.normals(), rng.normal(size=(50, 3))])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        opacity = -np.expm1(-optical_depth(one, one.centres - 50 * directions, directions))
        assert opacity[0] == pytest.approx(one.opacities[0], rel=1e-9)
        assert (opacity >= one.opacities[0] - 1e-9).all()


def test_opacities_are_clipped_as_the_rasteriser_does():
    one = random_splats(1)
    opaque = Splats(one.centres, one.scales, one.rotations, np.ones(1), one.colours)
    assert opaque.depths()[0] == pytest.approx(-np.log(1 - MAX_OPACITY))


def test_quaternions_turn_as_rotations_do():
    """A quarter turn about z maps x to y."""
    half = np.sqrt(0.5)
    assert np.allclose(matrices(np.array([[half, 0, 0, half]]))[0] @ [1, 0, 0], [0, 1, 0])


def test_boxes_hold_the_ellipsoids():
    splats = random_splats(6)
    rng = np.random.default_rng(2)
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = np.einsum("nij,nj,kj->nki", splats.axes(), 3 * splats.scales, sphere)
    reach = splats.reach(3.0)
    assert (np.abs(points).max(1) <= reach + 1e-12).all() and (np.abs(points).max(1) > 0.97 * reach).all()


def test_other_shapes_are_refused():
    one = random_splats(2)
    with pytest.raises(MiNtfError, match="scales have the shape"):
        Splats(one.centres, one.scales[:1], one.rotations, one.opacities, one.colours)


def _shell(count: int) -> Splats:
    rng = np.random.default_rng(3)
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    half = np.stack([1 + out[:, 2], -out[:, 1], out[:, 0], np.zeros(count)], 1)
    return Splats(out, np.tile([0.05, 0.05, 0.005], (count, 1)), half / np.linalg.norm(half, axis=1, keepdims=True),
                  np.full(count, 0.9), np.ones((count, 3)))


def test_normals_of_a_shell_point_outwards():
    """Those of flat splats are exact; those of round ones follow the openness."""
    shell = _shell(20000)
    box = np.full(3, -1.2), np.full(3, 1.2)
    assert (np.sum(splat_normals.outward(shell, *box) * shell.centres, 1) > 0.99).mean() > 0.999
    round_ones = Splats(shell.centres, np.full((len(shell), 3), 0.02), shell.rotations, shell.opacities, shell.colours)
    assert np.quantile(np.sum(splat_normals.outward(round_ones, *box) * shell.centres, 1), 0.05) > 0.8


def test_openness_is_one_in_front_of_a_wall_and_half_beside_it():
    """The depth along a direction is that of the cells in front: a wall of ln 2 halves the light."""
    sigma = np.zeros((4, 4, 8))
    sigma[:, :, 4] = np.log(2)
    depth = splat_normals._depth(sigma, (0, 0, 1))
    assert np.allclose(np.exp(-depth[1, 1]), [0.5] * 4 + [1.0] * 4)
    slanted = splat_normals._depth(sigma, (0, 1, 1))
    assert np.allclose(np.exp(-slanted[0, 3]), [1, 1, 1, 2 ** -np.sqrt(2)] + [1.0] * 4, atol=1e-9) or (
        np.allclose(slanted[0, 1, 2:4], np.sqrt(2) * np.log(2)))
