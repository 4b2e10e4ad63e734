"""Voxels of bricks as numbers of their own, against dense arrays."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ntf.infer.backend import floats, module_of
from mi_ntf.infer.blocks import Blocks
from mi_ntf.infer.bricks import NUMBER, Bricks, of_dense


@pytest.fixture
def content(rng):
    """Bricks of 20 × 23 × 17 voxels, matter in a part of them, and the dense values (z, y, x), 0 in empty bricks."""
    values = rng.random((17, 23, 20)).astype(np.float32) + 0.5
    mask = np.zeros(values.shape, bool)
    mask[2:9, 1:12, 3:10] = mask[14:, 20:, 17:] = True
    dj = module_of(mi.Float)
    bricks = Bricks(of_dense(values[..., None], mask), dj)
    occupied = (bricks.index.numpy().reshape((bricks.side,) * 3) & np.uint32(NUMBER)) > 0
    read = np.zeros((32,) * 3, bool)  # voxels of occupied bricks, some of them on faces of empty ones
    for place in np.argwhere(occupied):
        read[tuple(slice(8 * k, 8 * k + 9) for k in place)] = True
    return np.where(read[:17, :23, :20], values, 0), bricks, Blocks(occupied, np.array([20, 23, 17]), dj)


def test_unpacked(content):
    """All voxels of bricks with matter occur once, with the values of the bricks."""
    dense, bricks, blocks = content
    (values,) = blocks.unpacked(bricks)
    x, y, z = (np.array(c).astype(int) for c in blocks.voxels())
    inside = (x < 20) & (y < 23) & (z < 17)
    found = np.zeros(dense.shape, np.float32)
    found[z[inside], y[inside], x[inside]] = np.array(values)[inside]
    np.testing.assert_allclose(found[dense > 0], dense[dense > 0], atol=2e-5)
    assert len(set(zip(x, y, z, strict=True))) == len(x)


def test_repacked(content, rng):
    """Bricks of new values interpolate as the values do, and octants without matter are empty."""
    _, bricks, blocks = content
    values = floats(np.where(rng.random(blocks.count * 512) < 0.7, rng.random(blocks.count * 512), 0), bricks._dj)
    packed = blocks.repacked(bricks, values, 0.0, 0.0)
    p = tuple(floats(c, bricks._dj) for c in rng.uniform(-0.8, 0.1, (3, 4000)))
    place = packed.place(p)
    inside = np.array(packed.occupied(place))
    np.testing.assert_allclose(np.array(packed.at(place)[0])[inside],
                               np.array(blocks.at(values, 1, place[:3])[0])[inside], atol=3e-5)
    assert inside.any()
    nothing = blocks.repacked(bricks, values * 0, 0.0, 0.0)
    one = (floats(np.full(4000, 1.0), bricks._dj),) * 3
    assert (np.array(nothing.clear_distance(nothing.place(p), one)) > 0).all()


def test_gradients_of_interpolation(content, rng):
    """The derivative by a voxel is its weight, by a place the slope of the interpolant."""
    _, bricks, blocks = content
    values = floats(rng.random(blocks.count * 512), bricks._dj)
    place = [floats(c, bricks._dj) for c in ([4.3], [6.6], [5.2])]
    dr.enable_grad(values, place)
    (found,) = blocks.at(values, 1, place)
    dr.backward(found)
    weights = np.array(dr.grad(values))
    assert weights.sum() == pytest.approx(1, abs=1e-6)
    assert sorted(weights[weights > 0]) == pytest.approx(
        sorted(a * b * c for a in (0.7, 0.3) for b in (0.4, 0.6) for c in (0.8, 0.2)), abs=1e-5)
    moved = [dr.detach(c) + e for c, e in zip(place, (1e-2, 0, 0), strict=True)]
    slope = (blocks.at(dr.detach(values), 1, moved)[0] - dr.detach(found)) / 1e-2
    assert float(dr.grad(place[0])[0]) == pytest.approx(float(slope[0]), rel=1e-2, abs=1e-4)
