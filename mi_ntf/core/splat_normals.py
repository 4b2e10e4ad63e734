"""Normals of Gaussian splats, towards the side that more light can reach."""

import itertools

import numpy as np
from numpy.typing import NDArray

from .splats import Splats

Array = NDArray[np.float64]

CELLS = 128
"""Cells along the longest side of the grid in which openness is computed."""
POINTS, MOST_POINTS = 1 << 21, 256
"""Number of points that carry the splats' mass into cells, all together and at most for each splat."""
AWAY = 1.5
"""Distance from a splat to the places on both of its sides whose openness is compared, cells."""


def outward(splats: Splats, low: Array, high: Array) -> Array:
    """Return a unit normal of each splat, (n, 3).

    A flat splat has its shortest axis, a round one the direction in which openness grows, others a mean of both.
    Openness is the transmittance to the outside, averaged over 26 directions. It differs between the two sides of a
    closed surface, where the gradient of the density alone would point inwards on one half of the layer.

    Parameters
    ----------
    splats
        The splats.
    low, high
        Box around them, (3,).
    """
    size = float((high - low).max()) / CELLS
    open_sky = np.pad(_openness(splats, low, size, np.ceil((high - low) / size).astype(int)), 1, constant_values=1.0)
    place = (splats.centres - low) / size + 0.5
    shortest = splats.normals()

    def openness(offset: Array) -> Array:
        return interpolated(open_sky, place + AWAY * offset)

    towards = openness(shortest) - openness(-shortest)
    gradient = np.stack([openness(axis) - openness(-axis) for axis in np.eye(3)], 1)
    gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    scales = np.sort(splats.scales, axis=1)
    flat = (1 - scales[:, 0] / scales[:, 1])[:, None]
    normals = flat * np.where(towards < 0, -1.0, 1.0)[:, None] * shortest + (1 - flat) * gradient
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    result: Array = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), shortest)
    return result


def _openness(splats: Splats, low: Array, size: float, counts: NDArray[np.int_]) -> Array:
    """Return the mean transmittance from each cell (z, y, x) to the outside, along 26 directions."""
    scales = np.sort(splats.scales.astype(np.float64), axis=1)
    mass = splats.depths() * 2 * np.pi * scales[:, 1] * scales[:, 2]
    axes = splats.axes() * splats.scales[:, None]
    sigma, rng = np.zeros(int(np.prod(counts))), np.random.default_rng(0)
    repeats = int(np.clip(POINTS // len(splats), 1, MOST_POINTS))
    for _ in range(repeats):
        points = splats.centres + (axes @ rng.normal(size=(len(splats), 3, 1)))[..., 0]
        cell = np.clip(((points - low) / size).astype(int), 0, counts - 1)
        number = (cell[:, 2] * counts[1] + cell[:, 1]) * counts[0] + cell[:, 0]
        sigma += np.bincount(number, mass, len(sigma))
    sigma = sigma.reshape(counts[::-1]) / (repeats * size**3)
    directions = [d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
    total: Array = sum((np.exp(-_depth(sigma * size, d)) for d in directions), np.zeros(sigma.shape))
    return total / len(directions)


def _depth(sigma: Array, direction: tuple[int, ...]) -> Array:
    """Return the optical depth from each cell along `direction`, in steps of whole cells; `sigma` in 1/cell."""
    axis = next(a for a in range(3) if direction[a])
    length = float(np.linalg.norm(direction))
    depth = np.zeros(sigma.shape)
    layers, results = np.moveaxis(sigma, axis, 0), np.moveaxis(depth, axis, 0)
    across = [d for a, d in enumerate(direction) if a != axis]
    order = range(len(layers) - 2, -1, -1) if direction[axis] > 0 else range(1, len(layers))
    for layer in order:
        following = layer + direction[axis]
        results[layer] = _shifted(results[following] + length * layers[following], across)
    return depth


def _shifted(layer: Array, offset: list[int]) -> Array:
    """Return ``layer[i + offset]``, 0 outside."""
    padded = np.pad(layer, 1)
    rows, columns = (slice(1 + o, 1 + o + n) for o, n in zip(offset, layer.shape, strict=True))
    shifted: Array = padded[rows, columns]
    return shifted


def interpolated(values: Array, place: Array) -> Array:
    """Return trilinear `values` (z, y, x), two an axis at least, at places (k, 3), x first, in cells from the first."""
    last = np.array(values.shape[::-1]) - 1
    place = np.clip(place, 0, last)
    cell = np.minimum(place.astype(int), last - 1)
    result = np.zeros(len(place))
    for corner in itertools.product((0, 1), repeat=3):
        x, y, z = (cell + corner).T
        result += np.prod(np.where(corner, place - cell, 1 - place + cell), axis=1) * values[z, y, x]
    return result
