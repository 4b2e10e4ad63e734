"""A field's density and reflectance, sampled once into sparse volumes, plain arrays."""

from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import TypeAlias

import drjit as dr
import numpy as np

from ..core.architecture import LOG_FLOOR
from ..core.spheres import fibonacci
from . import bricks
from .backend import words
from .bricks import SIDE, any_between, bricks_per_side, grown
from .network import LOG_MIN_DENSITY, NetworkField
from .types import Float, Reflected, Vector

VERSION = 2
"""Version of the arrays; arrays of other versions in field files are not read."""
SURVEY = 192
"""Largest number of voxels per side of the first, dense sampling. Bricks are sampled only near its density."""
REFLECTANCE_RESOLUTION = 128
"""Largest number of voxels per side of reflectance and of softness."""
CHANNELS = 10
"""Channels of a reflectance: normal (3), albedo (3), roughness, specular weight (3)."""
EMPTY = 1 << 20
"""Coordinate of a line without density, farther than any voxel."""
PART = 1 << 20
"""Number of points that are evaluated together, which bounds the memory."""
Progress: TypeAlias = Callable[[float], None]
"""Receives the fraction of the work that is done."""


def bake(field: NetworkField, resolution: int, dj: ModuleType,
         progress: Progress = lambda done: None) -> dict[str, np.ndarray]:
    """Return the arrays of a :class:`mi_ntf.infer.grid.GridField`: ln σ at `resolution`³ voxels, and arrays from it.

    Names with a dot are arrays of :class:`mi_ntf.infer.bricks.Bricks`. ``density`` holds ln σ, since the networks' own
    σ is the exponential of a smooth function. Its voxels hold the coefficients f − f″/12 along each axis, between which
    trilinear interpolation is right on average (Condat and Möller 2011, quasi-interpolation); none exceeds the highest
    sample. ``reflectance``, only of fields with a slow network, has the channels of :func:`flat`. ``hull`` (k, 3):
    points whose convex hull holds all density. ``numbers``: upper bound of the density; highest specular lobe,
    s/(4 α²), at a voxel with matter. `progress` receives about the fraction of the time.
    """
    places, values = _density(field, resolution, dj, lambda done: progress(0.6 * done))
    coarse = min(resolution, REFLECTANCE_RESOLUTION)
    octants = bricks.octants_of(values > LOG_MIN_DENSITY)
    ends, matter = _outline(places, values, resolution, coarse)
    result = _named("density", bricks.pack(values[:, None], places, octants, resolution, LOG_FLOOR))
    majorant = float(np.exp(values.max())) if len(values) else 0.0
    del values
    progress(0.7)
    index = np.flatnonzero(matter)
    matter_reflectance = at_voxels(lambda p: flat(field.reflectance(p)), CHANNELS, index, coarse, dj)
    gloss = float((matter_reflectance[:, 7:] / (4 * matter_reflectance[:, 6:7] ** 4)).max(initial=0.0))
    if not field.quick:
        near = np.flatnonzero(grown(matter))
        dense = np.zeros((coarse**3, CHANNELS), np.float32)
        dense[near] = at_voxels(lambda p: flat(field.reflectance(p)), CHANNELS, near, coarse, dj)
        result |= _named("reflectance", bricks.of_dense(dense.reshape(coarse, coarse, coarse, CHANNELS), matter))
    return result | {"hull": support_points(ends, resolution), "numbers": np.array([majorant, gloss])}


def _named(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def _density(field: NetworkField, n: int, dj: ModuleType, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """Return the places (bricks, 3), z first, and voxels (bricks, 9, 9, 9) of all bricks that hold density."""
    parts = [(np.zeros((0, 3), int), np.zeros((0,) + (SIDE + 1,) * 3, np.float32))]
    highest = LOG_FLOOR
    for places, samples in sampled_bricks(field, n, (-1, SIDE + 2), dj, progress, field.learned_log_density):
        highest = max(highest, float(samples.max()))
        for axis in (1, 2, 3):
            inner, before, after = (samples[(slice(None),) * axis + (slice(k, k + samples.shape[axis] - 2),)]
                                    for k in (1, 0, 2))
            samples = (14 * inner - before - after) / 12
        dense = (samples > LOG_MIN_DENSITY).any((1, 2, 3))
        parts.append((places[dense], samples[dense]))
    places, values = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    np.minimum(values, np.float32(highest), out=values)
    if field.refined_density:  # by differences of such coefficients, within the bricks of the networks
        values += at_bricks(field.refined_density.at, places, (0, SIDE + 1), n, dj)
        np.maximum(values, LOG_FLOOR, out=values)
    return places, values


def sampled_bricks(field: NetworkField, n: int, reach: tuple[int, int], dj: ModuleType,
                   progress: Progress = lambda done: None, log_density: Callable[[Vector], Float] | None = None
                   ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield parts of all bricks near density: places (k, 3), z first, and ln σ of their voxels, at least `LOG_FLOOR`.

    `reach`: as in :func:`at_bricks`. `log_density`: function to sample in place of the field's own. A voxel that
    several bricks read is evaluated once.
    """
    function = log_density or field.log_density
    places = _near_density(field, n, dj, lambda done: progress(done / 2))
    slab = np.full((reach[1] - reach[0], n, n), np.nan, np.float32)  # voxels that a layer of bricks reads
    for layer in range(bricks_per_side(n)):
        progress((1 + layer / bricks_per_side(n)) / 2)
        slab = np.concatenate([slab[SIDE:], np.full((SIDE, n, n), np.nan, np.float32)])
        part = places[places[:, 0] == layer]
        if not len(part):
            continue
        z = np.clip(SIDE * layer + np.arange(*reach), 0, n - 1)
        y, x = (np.clip(SIDE * part[:, axis, None] + np.arange(*reach), 0, n - 1) for axis in (1, 2))
        read = np.zeros((n, n), bool)
        read[y[:, :, None], x[:, None, :]] = True
        missing = np.isnan(slab) & read
        plane, place = np.divmod(np.flatnonzero(missing), n * n)
        slab[missing] = at_voxels(lambda p: [function(p)], 1, z[plane] * (n * n) + place, n, dj)[:, 0]
        samples = slab[:, y[:, :, None], x[:, None, :]].swapaxes(0, 1)
        yield part, np.maximum(samples, LOG_FLOOR)


def _near_density(field: NetworkField, n: int, dj: ModuleType, progress: Progress) -> np.ndarray:
    """Return the places (k, 3), z first, of all bricks of n³ voxels near density.

    Only the unit sphere is looked at, since rays are marched nowhere else.
    """
    survey = min(n, SURVEY)
    z, y, x = np.ogrid[:survey, :survey, :survey]
    half = (survey - 1) / 2
    ball = np.flatnonzero((z - half) ** 2 + (y - half) ** 2 + (x - half) ** 2 < (survey / 2 + 1) ** 2)
    matter = np.zeros((survey,) * 3, bool)
    matter.ravel()[ball] = at_voxels(lambda p: [field.log_density(p)], 1, ball, survey, dj, progress)[:, 0] > LOG_FLOOR
    first, last = ((SIDE * np.arange(bricks_per_side(n)) + k) * 2 + 1 for k in (0, SIDE))
    return np.argwhere(any_between(grown(matter), first * survey // (2 * n), last * survey // (2 * n)))


def at_bricks(function: Callable[[Vector], Sequence[Float]], places: np.ndarray, reach: tuple[int, int], n: int,
              dj: ModuleType) -> np.ndarray:
    """Return ``function(p)``, a list of one array, at the voxels of bricks; (bricks, edge, edge, edge), z first.

    `places`: (bricks, 3), z first. `reach`: the first voxel of an edge and the one behind its last, counted from the
    brick's first. Voxels outside the volume are those of its border.
    """
    voxels = np.clip(SIDE * places[..., None] + np.arange(*reach), 0, n - 1).astype(np.uint32)
    z, y, x = voxels[:, 0, :, None, None], voxels[:, 1, None, :, None], voxels[:, 2, None, None, :]
    edge = reach[1] - reach[0]
    return at_voxels(function, 1, ((z * n + y) * n + x).ravel(), n, dj).reshape(-1, edge, edge, edge)


def at_voxels(function: Callable[[Vector], Sequence[Float]], count: int, index: np.ndarray | None, n: int,
              dj: ModuleType, progress: Progress = lambda done: None) -> np.ndarray:
    """Return ``function(p)``, a list of `count` arrays, at the centres of voxels; (voxels, count), float32.

    `index`: numbers of the voxels among n³, x fastest; None: all of them.
    """
    total = n**3 if index is None else len(index)
    result = np.empty((total, count), np.float32)
    side, size = dr.opaque(dj.UInt32, n), dr.opaque(dj.Float, 2 / n)
    for first in range(0, total, PART):
        progress(first / total)
        end = min(first + PART, total)
        voxel = words(np.arange(first, end) if index is None else index[first:end], dj)
        place = voxel % side, voxel // side % side, voxel // (side * side)
        values = function(tuple((dj.Float(c) + 0.5) * size - 1 for c in place))
        dr.eval(values)
        for k, v in enumerate(values):
            result[first:end, k] = v.numpy()
    return result


def flat(reflectance: Reflected) -> list[Float]:
    """Return a reflectance as ``CHANNELS`` channels."""
    normal, albedo, roughness, specular = reflectance
    return [*normal, *albedo, roughness, *specular]


def _outline(places: np.ndarray, values: np.ndarray, n: int, coarse: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the outline of the density and a mask of the coarse³ voxels (z, y, x) that hold some.

    The outline are the voxels (k, 3), x first, at the ends of lines along x that may be corners of the density's convex
    hull.
    """
    low, high = np.full((n + 1, n + 1), n, np.int32), np.full((n + 1, n + 1), -1, np.int32)
    matter = np.zeros((coarse,) * 3, bool)
    for place, value in zip(*(np.array_split(a, max(1, len(places) // 512)) for a in (places, values)), strict=True):
        dense = value > LOG_MIN_DENSITY
        z, y, x = np.minimum(SIDE * place.T[..., None] + np.arange(SIDE + 1), n - 1)  # (bricks, 9) each
        brick, line_z, line_y = np.nonzero(dense.any(3))
        line = dense[brick, line_z, line_y]
        where = z[brick, line_z], y[brick, line_y]
        np.minimum.at(low, where, x[brick, line.argmax(1)])
        np.maximum.at(high, where, x[brick, SIDE - line[:, ::-1].argmax(1)])
        brick, *at = np.nonzero(dense)
        matter[tuple(c[brick, i] * coarse // n for c, i in zip((z, y, x), at, strict=True))] = True
    ends = []
    for sign, side in ((1, low), (-1, high)):
        z, y = np.nonzero(_corners(np.where(high < 0, EMPTY, sign * side)))
        ends.append(np.stack([side[z, y], y, z], 1))
    return np.concatenate(ends), matter


def _corners(heights: np.ndarray) -> np.ndarray:
    """Return a mask of the `heights` (z, y), `EMPTY` where there is nothing, that may be corners of their lower hull.

    A height that is no lower than the middle between two neighbours on opposite sides is none.
    """
    result, padded = heights < EMPTY, np.pad(heights, 1, constant_values=EMPTY)
    n, m = heights.shape
    for z, y in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before, after = (padded[1 + k * z : 1 + k * z + n, 1 + k * y : 1 + k * y + m] for k in (-1, 1))
        result &= 2 * heights < before + after
    return result


def support_points(voxels: np.ndarray, n: int, directions: int = 1200) -> np.ndarray:
    """Return the furthest points along many directions that interpolation between `voxels` (k, 3) of n³ can reach.

    Voxels and points (k, 3), float64, have x first; without voxels the one point is the origin.
    """
    if not len(voxels):
        return np.zeros((1, 3))
    points = (voxels + 0.5) * (2 / n) - 1
    fan = np.concatenate([fibonacci(directions), np.eye(3), -np.eye(3)])
    furthest = np.concatenate([(points @ part.T).argmax(0) for part in np.array_split(fan, 40)])
    reach = np.where(fan < 0, -2 / n, 2 / n)  # a voxel fades out at its neighbours
    result: np.ndarray = np.clip(np.unique(points[furthest] + reach, axis=0), -1, 1)
    return result
