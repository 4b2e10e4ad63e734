r"""Gaussian splats as a participating medium, in NumPy float64: the oracle of their voxels.

A splat is a Gaussian of extinction, σ(x) = k exp(−½ (x−μ)ᵀ Σ⁻¹ (x−μ)). Its optical depth along a ray, infinite to both
sides, through the centre is k √(2π) s, where s is the standard deviation along the ray. It differs with direction if
the splat is anisotropic, whereas the opacity α of Gaussian splatting is one number. Here the ray along the shortest
axis has the opacity α:

    k = −ln(1 − α) / (√(2π) s_min).

A camera sees a flat splat of a surface along this axis. No ray through the centre is less opaque, since s ≥ s_min.
The code of EVER (Mai et al. 2024) also turns an opacity into a density along the minor axis. Condor et al. (2025,
volumetric primitives) store the density itself. The integrator ``volprim_rf_basic`` of Mitsuba evaluates the
opacity of 3D Gaussian ray tracing, which is the same along every ray through the centre and so belongs to no density.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .errors import MiNtfError, shown

Array = NDArray[np.float64]

MAX_OPACITY = 0.99
"""Largest opacity of a splat; the rasteriser of Kerbl et al. (2023) clips at this value."""
FARTHEST = 8.0
"""Distance, standard deviations along the longest axis, from which a ray is clear of a splat: e^(−32) of its peak."""
_SQRT_2PI = np.sqrt(2 * np.pi)


@dataclass(frozen=True)
class Splats:
    """Anisotropic Gaussians of extinction.

    Attributes
    ----------
    centres
        Means μ, (n, 3), scene units.
    scales
        Standard deviations along the axes of each splat, (n, 3), above 0.
    rotations
        Unit quaternions (w, x, y, z) that turn these axes into the scene, (n, 4).
    opacities
        Opacity along the shortest axis, (n,), 0 to ``MAX_OPACITY``.
    colours
        Linear RGB, (n, 3), 0 to 1.
    """

    centres: NDArray[np.floating]
    scales: NDArray[np.floating]
    rotations: NDArray[np.floating]
    opacities: NDArray[np.floating]
    colours: NDArray[np.floating]

    def __post_init__(self) -> None:
        n = len(self.centres)
        for name, shape in (("centres", (n, 3)), ("scales", (n, 3)), ("rotations", (n, 4)), ("opacities", (n,)),
                            ("colours", (n, 3))):
            if getattr(self, name).shape != shape:
                raise MiNtfError(f"splats: {name} have the shape {shown(getattr(self, name).shape)}, expected {shape}")

    def __len__(self) -> int:
        return len(self.centres)

    def take(self, index: NDArray[np.integer] | slice | NDArray[np.bool_]) -> "Splats":
        """Return the splats at `index`."""
        return Splats(*(getattr(self, f.name)[index] for f in fields(self)))

    def depths(self) -> Array:
        """Return the optical depth along the shortest axis of each splat, −ln(1 − α), (n,)."""
        return -np.log1p(-np.minimum(np.asarray(self.opacities, np.float64), MAX_OPACITY))

    def peaks(self) -> Array:
        """Return the extinction k at the centre of each splat, 1/scene unit, (n,)."""
        peaks: Array = self.depths() / (_SQRT_2PI * self.scales.min(1).astype(np.float64))
        return peaks

    def axes(self) -> Array:
        """Return rotation matrices (n, 3, 3), whose columns are the splats' axes in the scene."""
        return matrices(self.rotations)

    def normals(self) -> Array:
        """Return the shortest axis of each splat, (n, 3), of arbitrary sign."""
        shortest = np.argmin(self.scales, axis=1)
        normals: Array = np.take_along_axis(self.axes(), shortest[:, None, None], 2)[..., 0]
        return normals

    def reach(self, deviations: float) -> Array:
        """Return half the edges of the box around each splat's ellipsoid of so many `deviations`, (n, 3)."""
        reach: Array = deviations * np.sqrt(np.sum((self.axes() * self.scales[:, None, :]) ** 2, axis=2))
        return reach


def matrices(quaternions: NDArray[np.floating]) -> Array:
    """Return the rotation matrices (n, 3, 3) of unit quaternions (n, 4), w first."""
    w, x, y, z = np.asarray(quaternions, np.float64).T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    result: Array = np.moveaxis(np.array(rows), 2, 0)
    return result


def density(splats: Splats, points: Array) -> Array:
    """Return the extinction of all `splats` at `points` (k, 3), 1/scene unit, (k,)."""
    axes, scales, peaks = splats.axes(), splats.scales.astype(np.float64), splats.peaks()
    result = np.zeros(len(points))
    for i, centre in enumerate(splats.centres.astype(np.float64)):
        local = (points - centre) @ axes[i] / scales[i]
        result += peaks[i] * np.exp(-0.5 * np.sum(local**2, axis=1))
    return result


def optical_depth(splats: Splats, origins: Array, directions: Array, distance: float | Array = np.inf) -> Array:
    """Return the optical depth of rays through all `splats`, a sum of error functions.

    Parameters
    ----------
    splats
        The splats.
    origins, directions
        Rays, (k, 3); the directions are normalised.
    distance
        Length of the rays, one number or (k,); infinite by default.

    Returns
    -------
    array of shape (k,)
        Σ k √(π/2)/a e^(−m²/2) (erf((t a + b)/√2) − erf(b/√2)) with a² = dᵀΣ⁻¹d, the ray's length t, its distance m
        from the centre in standard deviations, and the distance b from the closest point to the origin. Splats that
        are more than ``FARTHEST`` standard deviations from the ray are left out.
    """
    axes, scales, peaks = splats.axes(), splats.scales.astype(np.float64), splats.peaks()
    centres = splats.centres.astype(np.float64)
    limit, ends = (FARTHEST * scales.max(1)) ** 2, np.broadcast_to(np.asarray(distance, np.float64), len(origins))
    result = np.zeros(len(origins))
    for ray, (origin, direction, end) in enumerate(zip(origins, directions, ends, strict=True)):
        middle = origin + ((centres.mean(0) - origin) @ direction) * direction  # keeps the digits of far origins
        squared = ((centres - middle) ** 2).sum(1) - ((centres - middle) @ direction) ** 2
        near = np.flatnonzero(squared < limit)
        local = np.swapaxes(axes[near], 1, 2) / scales[near, :, None]
        o, d = np.einsum("nij,nj->ni", local, origin - centres[near]), local @ direction
        result[ray] = peaks[near] @ _integral(o, d, end)
    return result


def _integral(o: Array, d: Array, end: float) -> Array:
    """Return ∫ exp(−½ |o + t d|²) dt from 0 to `end` for each row of `o` and `d`."""
    a = np.sqrt(np.sum(d * d, axis=1))
    b = np.sum(o * d, axis=1) / a  # standard deviations from the closest place to the origin
    closest = np.exp(-0.5 * np.sum((o - (b / a)[:, None] * d) ** 2, axis=1))
    result: Array = closest * np.sqrt(np.pi / 2) / a * (_erf((end * a + b) / np.sqrt(2)) - _erf(b / np.sqrt(2)))
    return result


def _erf(x: Array) -> Array:
    """Return the error function of `x`."""
    return np.fromiter(map(math.erf, x), np.float64, len(x))
