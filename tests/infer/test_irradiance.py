"""Irradiance at any point: constants stay constant, faces are separate, cells are interpolated."""

import mitsuba as mi
import numpy as np
from helpers.jit import arrays

from mi_ntf.core import radiosity
from mi_ntf.infer.irradiance import Irradiance

CELLS = radiosity.CELLS


def test_faces_are_weighted_by_the_squares_of_the_normal():
    values = np.arange(18.0).reshape(6, 3)
    table = np.broadcast_to(np.arange(6)[:, None, None, None], (6, CELLS, CELLS, CELLS))
    rng = np.random.default_rng(0)
    p, n = rng.uniform(-1, 1, (2, 500, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    actual = np.stack([c.numpy() for c in Irradiance(table, values, mi)(arrays(p), arrays(n))], 1)
    exact = sum((n[:, k] ** 2)[:, None] * np.where(n[:, [k]] < 0, values[2 * k + 1], values[2 * k]) for k in range(3))
    np.testing.assert_allclose(actual, exact, rtol=1e-5)


def test_cells_are_trilinear_and_faces_are_separate():
    """The values of one face grow along z: linear between the cells' middles, constant beyond the ends."""
    column = np.full((6, CELLS), -1)
    column[4] = np.arange(CELLS)  # +z
    table = np.broadcast_to(column[:, :, None, None], (6, CELLS, CELLS, CELLS))
    values = np.repeat(np.arange(CELLS, dtype=float)[:, None], 3, 1)
    z = np.linspace(-1, 1, 301)
    p = np.stack([0 * z, 0 * z, z], 1)
    light = Irradiance(table, values, mi)
    up = light(arrays(p), arrays(np.tile([0, 0, 1.0], (301, 1))))[0].numpy()
    np.testing.assert_allclose(up, np.clip((z + 1) * CELLS / 2 - 0.5, 0, CELLS - 1), atol=1e-3)
    assert not light(arrays(p), arrays(np.tile([0, 1.0, 0], (301, 1))))[0].numpy().any()
