"""Voxels of the extinction of Mitsuba's media."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import splat_normals
from ...core.errors import MiNtfError
from ...infer.bake import PART

TOLERANCE = 1e-3
"""Root mean square error of interpolated extinction, relative to the largest extinction, that needs no more voxels."""
PROBES = 1 << 14
"""Number of random points at which this error is measured."""
MOST_VOXELS = 1 << 27
"""Largest number of voxels that are sampled, half a gigabyte."""
COLOURED = 1e-4
"""Difference between the extinctions of two channels, relative to the largest, from which a medium is coloured."""


def extinction_volume(medium: mi.Medium) -> mi.Volume | None:
    """Return the volume of the extinction of `medium`, None if it shows none."""
    parameters = mi.traverse(medium)
    for key, _ in parameters:
        node = parameters.properties[key][2]
        while key.startswith("sigma_t") and node is not None:
            if isinstance(node, mi.Volume):
                return node
            node = parameters.hierarchy[node][0]
    return None


def sampled(medium: mi.Medium, low: np.ndarray, high: np.ndarray, name: str) -> np.ndarray:
    """Return the extinction (z, y, x), 1/scene unit, at the voxels of a box.

    Their number along each axis is that of the medium's own grid, or more where interpolation would be wrong between
    them, as in a grid that is turned.
    """
    volume = None if medium.is_homogeneous() else extinction_volume(medium)
    counts = np.full(3, 2) if volume is None else np.maximum(np.array(volume.resolution(), int).ravel(), 2)
    rng = np.random.default_rng(5)
    probe = rng.uniform(0.5 / counts, 1 - 0.5 / counts, (PROBES, 3))
    truth = _extinction(medium, low + probe * (high - low), name)
    while True:
        index = np.stack(np.meshgrid(*(np.arange(n) for n in counts[::-1]), indexing="ij"), -1)[..., ::-1]
        values = _extinction(medium, low + (index.reshape(-1, 3) + 0.5) / counts * (high - low), name)
        values = values.reshape(counts[::-1])
        error = np.sqrt(np.mean((splat_normals.interpolated(values, probe * counts - 0.5) - truth) ** 2))
        if error <= TOLERANCE * max(values.max(), 1e-30) or np.prod(2.0 * counts) > MOST_VOXELS:
            return values
        counts = 2 * counts


def _extinction(medium: mi.Medium, points: np.ndarray, name: str) -> np.ndarray:
    """Return the extinction at scene points (k, 3). Raises MiNtfError if it differs between the channels."""
    result = np.empty(len(points), np.float32)
    for first in range(0, len(points), PART):
        part = points[first : first + PART].T.astype(np.float32)
        mei = dr.zeros(mi.MediumInteraction3f, part.shape[1])
        mei.p = mi.Point3f(*(mi.Float(c) for c in part))
        sigma = np.array(mi.Color3f(medium.get_scattering_coefficients(mei)[2])).reshape(3, -1)
        if np.ptp(sigma, axis=0).max() > COLOURED * max(sigma.max(), 1e-30):
            raise MiNtfError(f"the medium of {name} has another sigma_t in each colour channel, which one "
                             "transmittance cannot hold; give sigma_t one number and colour the albedo, or render with "
                             "volpath")
        result[first : first + PART] = sigma[0]
    return result
