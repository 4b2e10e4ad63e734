"""A field's surface: triangles around its dense matter, with the reflectance that a camera sees there.

Fields are skins: photographs do not show the inside, where training leaves arbitrary matter. Enclosed space therefore
counts as solid.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import drjit as dr
import numpy as np

from ..core.architecture import LOG_FLOOR, MAX_LOG_DENSITY
from ..core.errors import MiNtfError
from .bake import CHANNELS, Progress, at_voxels, flat, sampled_bricks
from .bricks import SIDE
from .network import NetworkField
from .types import Array
from .volume import VoxelVolume

LEVEL = 10.0
"""σ of the surface, 1/(unit-sphere radius). Tuned on the mean distance to the photographed meshes of four objects:
lower levels lie outside of them, higher ones tear skins open."""
TIGHT = 0.3
"""Fraction of the level at which a skin counts as closed when the space that it encloses is filled."""
CRUMB = 1e-4
"""Number of voxels, over those of the largest part, below which a part is removed."""
RESOLUTIONS = (32, 512)
"""Least and largest number of voxels per side; 512 takes about 2 GB of memory."""
BEFORE, BEHIND, STEP = 0.008, 0.032, 0.004
"""Begin, end and step of a camera's look along the normal, before and behind the surface, field units."""
UNSEEN = 1e-3
"""Opacity of a look up to which it shows no matter."""
PART = 1 << 18
"""Vertices that are evaluated together, about 100 MB."""


@dataclass(frozen=True)
class Surface:
    """A surface in the coordinates of the field.

    `level`: its σ; `vertices`, `normals`, `albedo` (V, 3), the last linear RGB; `roughness` (V,);
    `specular` (V, 3), the weight of the specular lobe, linear RGB; `faces` (F, 3), counter-clockwise seen from outside.
    """

    level: float
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    roughness: np.ndarray
    specular: np.ndarray


def surface(field: NetworkField | VoxelVolume, resolution: int, level: float | None, dj: ModuleType,
            progress: Progress = lambda done: None) -> Surface:
    """Return the surface of `field` at density `level`, from `resolution`³ voxels.

    `level` None: ``LEVEL``, or half of the highest density where that is less. `progress` receives about the fraction
    of the time. Raises MiNtfError if the field has no such density.
    """
    from skimage import measure

    marching_cubes: Callable[..., Array] = measure.marching_cubes
    values = _log_density(field, resolution, dj, lambda done: progress(done / 2))
    highest = float(np.exp(values.max()))
    level = min(LEVEL, highest / 2) if level is None else level
    if not level < highest:
        raise MiNtfError(f"no density of {level:g} in the field, the highest is {highest:.3g}; give a lower --level")
    gap = round((BEFORE + BEHIND) * resolution / 4)  # a camera's look through a skin is deeper than such gaps are wide
    values, corner = _cropped(values, np.log(TIGHT * level), gap + 1)
    values = _solid(values, level, gap)
    places, faces, _, _ = marching_cubes(values, np.log(level))
    del values
    vertices = (places[:, ::-1] + corner[::-1] + 0.5) * (2 / resolution) - 1
    normals = _from_faces(vertices, faces)
    return Surface(level, vertices, faces, *_reflectance(field, vertices, normals, dj,
                                                         lambda done: progress(0.7 + 0.3 * done)))


def _log_density(field: NetworkField | VoxelVolume, n: int, dj: ModuleType, progress: Progress) -> np.ndarray:
    """Return ln σ at the centres of n³ voxels (z, y, x), ``LOG_FLOOR`` at least and away from density."""
    if isinstance(field, VoxelVolume):
        logs = at_voxels(lambda p: [field.log_density(field.place(p))], 1, None, n, dj, progress)
        cube: np.ndarray = np.maximum(logs.reshape(n, n, n), LOG_FLOOR)
        return cube
    values = np.full((n, n, n), LOG_FLOOR, np.float32)
    for places, samples in sampled_bricks(field, n, (0, SIDE), dj, progress):
        for (z, y, x), brick in zip(SIDE * places, samples, strict=True):
            part = values[z : z + SIDE, y : y + SIDE, x : x + SIDE]
            part[:] = brick[tuple(slice(size) for size in part.shape)]
    return values


def _cropped(values: np.ndarray, threshold: float, border: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of `values` (z, y, x) above `threshold`, in an empty `border`, and its first voxel's index."""
    dense = values > threshold
    sides = [np.flatnonzero(dense.any(tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    inner = values[tuple(slice(s[0], s[-1] + 1) for s in sides)]
    return np.pad(inner, border, constant_values=values.min()), np.array([s[0] - border for s in sides])


def _solid(values: np.ndarray, level: float, gap: int) -> np.ndarray:
    """Return ln σ with enclosed space filled, and without small parts.

    Space is also enclosed if it opens outward only by gaps of at most 2 `gap` voxels: skins are torn where few
    photographs look. Inside and outside meet at the highest density of the skin between them.
    """
    from scipy.ndimage import binary_erosion, label
    from skimage.segmentation import watershed

    empty = values <= np.log(TIGHT * level)
    wide = binary_erosion(empty, iterations=gap, border_value=1) if gap else empty
    within = _enclosed(wide) | _enclosed(empty)
    values = np.where(watershed(values, np.where(within, 2, wide)) == 2, np.float32(MAX_LOG_DENSITY), values)
    values = np.where(_enclosed(values <= np.log(level)), np.float32(MAX_LOG_DENSITY), values)
    parts, count = label(values > np.log(level), output=np.int32)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    small = sizes < CRUMB * sizes[1:].max()
    small[0] = False
    return np.where(small[parts], values.min(), values)


def _enclosed(empty: np.ndarray) -> np.ndarray:
    """Return a mask of the `empty` voxels that are not connected with the first one, which lies outside."""
    from scipy.ndimage import label

    parts, _ = label(empty, output=np.int32)
    mask: np.ndarray = empty & (parts != parts[0, 0, 0])
    return mask


def _from_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals (V, 3), means of the faces around each vertex by area."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack([sum(np.bincount(faces[:, i], across[:, axis], len(vertices)) for i in range(3))
                      for axis in range(3)], axis=1)
    unit: np.ndarray = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return unit


def _reflectance(field: NetworkField | VoxelVolume, vertices: np.ndarray, normals: np.ndarray, dj: ModuleType,
                 progress: Progress) -> tuple[np.ndarray, ...]:
    """Return normals, albedo, roughness and specular weight, as a camera that looks along each normal sees them.

    They are means weighted by opacity, as in rendering. A vertex on the closing of a gap sees nothing, and has the
    values of the nearest one that sees matter.
    """
    from scipy.spatial import cKDTree

    result, opacity = np.empty((len(vertices), CHANNELS), np.float32), np.empty(len(vertices), np.float32)
    for first in range(0, len(vertices), PART):
        progress(first / len(vertices))
        part = slice(first, first + PART)
        p, n = (tuple(dj.Float(np.ascontiguousarray(column, np.float32)) for column in array[part].T)
                for array in (vertices, normals))
        clear, sums = dj.Float(1), [dj.Float(0) for _ in range(CHANNELS)]
        for depth in np.arange(-BEFORE, BEHIND, STEP) + STEP / 2:
            at = tuple(c - dr.opaque(dj.Float, float(depth)) * m for c, m in zip(p, n, strict=True))
            after = clear * dr.exp(-STEP * field.density(at))
            sums = [s + (clear - after) * v for s, v in zip(sums, flat(field.reflectance(at)), strict=True)]
            clear = after
            dr.eval(clear, sums)
        weight = dr.maximum(1 - clear, 1e-6)
        result[part], opacity[part] = np.stack([(s / weight).numpy() for s in sums], axis=1), weight.numpy()
    seen = opacity > UNSEEN
    if seen.any():
        result[~seen] = result[seen][cKDTree(vertices[seen]).query(vertices[~seen])[1]]
    return _outward(result[:, :3], normals), result[:, 3:6], result[:, 6], result[:, 7:]


def _outward(normals: np.ndarray, geometric: np.ndarray) -> np.ndarray:
    """Return unit `normals`, or the `geometric` ones where those point sideways or inward, unseen in photographs."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    return np.where(((unit * geometric).sum(1) > 0.2)[:, None], unit, geometric).astype(np.float32)
