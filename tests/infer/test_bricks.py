"""Sparse volumes against dense ones: lookups, empty space, and bakes."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, volumes
from helpers.jit import arrays
from scipy.ndimage import distance_transform_cdt, map_coordinates

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer import bake, bricks
from mi_ntf.infer.bricks import SIDE, Bricks
from mi_ntf.infer.bundle import safe_inverse
from mi_ntf.infer.grid import NetworkVolume, baked
from mi_ntf.infer.network import NOTHING, NetworkField


def random_volume(rng, n: int, filled: float, channels: int = 1) -> tuple[np.ndarray, Bricks]:
    """Values (z, y, x, channels) that differ from 0 in some boxes, and their bricks."""
    values = rng.uniform(-9, 7, (n, n, n, channels)).astype(np.float32)
    side = -(-n // 5)
    mask = np.kron(rng.random((side,) * 3) < filled, np.ones((5, 5, 5), bool))[:n, :n, :n]
    values[~mask] = 0
    return values, Bricks(bricks.of_dense(values, mask), mi)


@pytest.mark.parametrize("n", [16, 17, 24, 41])
def test_lookups_are_trilinear(n, rng):
    """Lookups of several channels are right to half a level, also beyond the outer voxels' centres."""
    values, volume = random_volume(rng, n, 0.3, 2)
    p = rng.uniform(-1.1, 1.1, (50_000, 3))
    places = ((p[:, ::-1] + 1) * n / 2 - 0.5).T
    for channel, actual in enumerate(volume.at(volume.place(arrays(p)))):
        truth = map_coordinates(values[..., channel].astype(np.float64), places, order=1, mode="nearest")
        level = np.ptp(values[..., channel]) / 0xFFFF
        # Coordinates are float32, and neighbours differ by up to 16.
        np.testing.assert_allclose(np.array(actual), truth, atol=0.51 * level + 2e-6 * n * 16)
    np.testing.assert_allclose(volumes.voxels(volume), values, atol=0.51 * level + 2e-6 * n * 16)
    unknown = np.array(volume.at(volume.place(arrays(np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]))))[0])
    assert np.isfinite(unknown[1:]).all()


def test_no_brick_and_all_bricks(rng):
    nothing = Bricks(bricks.of_dense(np.zeros((20, 20, 20, 1), np.float32), np.zeros((20, 20, 20), bool)), mi)
    p = arrays(rng.uniform(-1, 1, (100, 3)))
    assert not np.array(nothing.at(nothing.place(p))[0]).any() and (nothing.distances() == bricks.FARTHEST).all()
    same = Bricks(bricks.of_dense(np.full((20, 20, 20, 1), 3, np.float32), np.ones((20, 20, 20), bool)), mi)
    np.testing.assert_allclose(np.array(same.at(same.place(p))[0]), 3, rtol=1e-5)
    assert not same.distances().any()


def test_more_bricks_than_the_index_numbers(monkeypatch):
    """A field full of fog at the finest resolution is refused: brick numbers would overflow into the octants' bits."""
    monkeypatch.setattr(bricks, "OCTANTS", 3)
    fog = np.ones((24, 24, 24, 1), np.float32)
    with pytest.raises(MiNtfError, match=r"of 24³ voxels takes 27 bricks, more than the 7 .* a lower resolution"):
        bricks.of_dense(fog, fog[..., 0] > 0)


def test_empty_space_is_empty(rng):
    """A ray from anywhere inside the sphere meets nothing within its clear distance, which is as long as possible: it
    ends at a face of an empty octant, or of the largest empty cube of bricks around."""
    values, volume = random_volume(rng, 120, 0.02)
    occupied = volume.distances() == 0
    truth = distance_transform_cdt(~occupied, "chessboard")
    np.testing.assert_array_equal(volume.distances(), np.minimum(truth, bricks.FARTHEST))
    x, d = rng.uniform(-0.57, 0.57, (4000, 3)), rng.normal(size=(4000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    clear = np.array(volume.clear_distance(volume.place(arrays(x)), safe_inverse(arrays(d))), np.float64)
    assert (clear > 0).any() and (clear == 0).any()
    for fraction in np.linspace(0.02, 0.999, 40):
        p = (x + fraction * clear[:, None] * d)[clear > 0]
        value = map_coordinates(values[..., 0], ((p[:, ::-1] + 1) * 60 - 0.5).T, order=1, mode="nearest")
        assert np.abs(value).max() < 1e-3
    # In units of bricks: where the ray leaves the cube, it is at a face, so many bricks away as the distance says.
    place = ((x + clear[:, None] * d + 1) * 60 - 0.5) / SIDE
    brick = np.clip(np.floor(((x + 1) * 60 - 0.5) / SIDE).astype(int), 0, volume.side - 1)
    n = volume.distances()[tuple(brick[:, ::-1].T)].astype(int)
    np.testing.assert_array_equal(np.array(volume.occupied(volume.place(arrays(x)))), n == 0)
    octant = np.floor(((x + 1) * 60 - 0.5) / (SIDE // 2)) / 2
    low, high = (np.where(n[:, None] > 0, a, b) for a, b in (
        (brick - n[:, None] + 1, octant), (brick + n[:, None], octant + 0.5)))
    error = np.abs(place - np.where(d > 0, high, low)).min(1)
    assert error[clear > 0].max() < 1e-3
    # Octants are told apart: some of a brick with matter are empty, and none of those that hold any.
    assert ((n == 0) & (clear > 0)).any()
    dense = np.abs(map_coordinates(values[..., 0], ((x[:, ::-1] + 1) * 60 - 0.5).T, order=1, mode="nearest")) > 1e-3
    assert (clear[dense] == 0).all()


def test_bake_finds_all_density(rng, monkeypatch):
    """A survey with coarser voxels finds all that a full survey does, also small blobs.

    It looks inside the sphere alone, and then each voxel near density is evaluated once.
    """
    network = NetworkField(*fields.blobs([(-0.2, 0.1, 0.0), (0.3, -0.2, 0.1)], [0.4, 0.06]), mi)
    evaluate, looked = bake.at_voxels, []

    def counted(function, count, index, n, *more):
        if count == 1:
            looked.append((n, index))
        return evaluate(function, count, index, n, *more)

    monkeypatch.setattr(bake, "at_voxels", counted)
    monkeypatch.setattr(bake, "SURVEY", 48)
    surveyed = bake.bake(network, 112, mi)
    assert looked[0][0] == 48 and len(looked[0][1]) < 0.6 * 48**3
    voxels = np.concatenate([index for n, index in looked if n == 112])
    assert len(voxels) < 112**3 / 2 and len(np.unique(voxels)) == len(voxels)
    monkeypatch.setattr(bake, "SURVEY", 112)
    whole = bake.bake(network, 112, mi)
    assert set(surveyed) == set(whole)
    for name in surveyed:
        np.testing.assert_array_equal(surveyed[name], whole[name], err_msg=name)


def test_parts_of_a_bake_do_not_show(monkeypatch):
    network = NetworkField(*fields.blobs([(-0.2, 0.1, 0.0)], [0.4]), mi)
    whole = bake.bake(network, 64, mi)
    monkeypatch.setattr(bake, "PART", 5000)
    for name, array in bake.bake(network, 64, mi).items():
        np.testing.assert_array_equal(array, whole[name], err_msg=name)


def test_grid_knows_where_density_is(rng):
    grid = baked(NetworkField(*fields.blobs([(-0.3, 0.1, 0.0)], [0.25]), mi), 96, mi)
    x = rng.uniform(-1, 1, (200000, 3))
    sigma = np.array(grid.density(arrays(x)))
    dense = x[sigma > 0]
    place = grid.place(arrays(dense))
    assert (np.array(grid.clear_distance(place, safe_inverse(arrays(np.ones_like(dense))))) == 0).all()
    assert (dense.min(0) >= grid.bounds[0]).all() and (dense.max(0) <= grid.bounds[1]).all()
    assert sigma.max() <= grid.majorant * (1 + 1e-4)
    # Seen from anywhere, the hull covers the density, and not much more: √3 voxels, and as many that no random x met.
    for direction in rng.normal(size=(100, 3)):
        direction /= np.linalg.norm(direction)
        assert (dense @ direction).max() <= (grid.hull @ direction).max()
        assert (grid.hull @ direction).max() < (dense @ direction).max() + 3.5 * 2 / 96


def test_empty_field():
    grid = baked(NetworkField(*fields.empty(), mi), 32, mi)
    assert grid.majorant == 0 and grid.gloss == 0 and (grid.hull == 0).all()
    assert (grid.bricks.distances() > 0).all()


def test_networks_have_the_empty_space_of_their_bricks(rng):
    """Network volumes have the networks' density in bricks, and none elsewhere."""
    network = NetworkField(*fields.blobs([(-0.3, 0.1, 0.0)], [0.25]), mi)
    grid = baked(network, 96, mi)
    volume = NetworkVolume(network, grid, 700.0)
    x = arrays(rng.uniform(-0.57, 0.57, (20000, 3)))
    place = volume.place(x)
    clear = np.array(volume.clear_distance(place, safe_inverse(arrays(np.ones((20000, 3))))))
    actual, truth = np.array(volume.log_density(place)), np.array(network.density(x))
    assert (actual[clear > 0] == NOTHING).all() and (clear > 0).any()
    inside = (clear == 0) & (truth > 0)
    np.testing.assert_allclose(np.exp(actual[inside]), truth[inside], rtol=1e-5)
    assert (actual[(clear == 0) & (truth == 0)] == NOTHING).all()
