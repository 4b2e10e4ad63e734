"""Representation of an environment by a few directional lights: exact integrals of its radiance over cells.

Mitsuba's ``envmap`` is bilinear between its texels: their columns are the centres of equal parts of the circle, their
first and last rows the poles. It is integrated exactly over a grid of blocks. The grid is cut into cells by a median
cut (Debevec 2005; Viriyothai and Debevec 2009). The next cell to be cut is the one that loses most by having one
direction, and it is cut where its halves lose least. The light of a cell comes from its centre of radiance.
"""

from __future__ import annotations

import hashlib
import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import spheres
from ...core.errors import MiNtfError
from ...infer.types import Color3, Vector3
from ..scene.recent import Recent, Version

ROWS = 512
"""Largest number of rows of blocks, and half of that of columns. Only a large number of lights needs more."""
FLOOR = 1e-2
"""Fraction of the mean radiance that is added everywhere before the cuts, so that dark regions get a few cells, whose
texels then have useful gradients."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)
Bounds = tuple[int, int, int, int]
"""First and end row, first and end column of blocks."""
_cells_of_images: Recent[Cells] = Recent()
_cells_of_emitters: Recent[Cells] = Recent(4)


@dataclass(frozen=True)
class Axis:
    """Latitudes or longitudes of a map, cut into pieces within which radiance is linear, and grouped into blocks.

    texel    (n,) texel where the interval of each piece begins; it ends at the next texel
    weights  (n, 2, 3) weights of the radiance of these two texels in the integral over the piece of the radiance times
             three functions of the angle: sin θ, sin² θ, sin θ cos θ of latitudes; 1, sin φ, −cos φ of longitudes
    first    (blocks,) first piece of each block
    """

    texel: np.ndarray
    weights: np.ndarray
    first: np.ndarray

    @property
    def sums(self) -> np.ndarray:
        """Integrals of the three functions over each block, (3, blocks)."""
        return np.asarray(np.add.reduceat(self.weights.sum(axis=1), self.first).T)

    @property
    def block(self) -> np.ndarray:
        """Block of each piece, (n,)."""
        return np.searchsorted(self.first, np.arange(len(self.texel)), side="right") - 1


def _axis(intervals: int, start: float, step: float, least: int, most: int,
          functions: Callable[[np.ndarray], tuple[np.ndarray, ...]]) -> Axis:
    """Return `intervals` of `step` radians from `start` on, in `least` or more blocks, if possible at most `most`."""
    parts = -(-least // intervals)
    piece = np.arange(intervals * parts)
    along = (piece[:, None] % parts + (NODES + 1) / 2) / parts  # (n, nodes), in intervals
    texel = piece // parts
    values = np.stack(functions(start + step * (texel[:, None] + along)), axis=-1)
    values *= (step / parts / 2 * WEIGHTS)[:, None]
    weights = np.stack([((1 - along)[..., None] * values).sum(1), (along[..., None] * values).sum(1)], axis=1)
    return Axis(texel, weights, np.arange(0, len(piece), -(-len(piece) // max(least, most))))


def axes(height: int, width: int, limit: int) -> tuple[Axis, Axis]:
    """Return latitudes and longitudes of a map of `height` × `width` texels that is cut into up to `limit` cells."""
    least = int(np.ceil(2 * np.sqrt(2 * limit)))  # 16 blocks a cell
    step = 2 * np.pi / width
    return (
        _axis(height - 1, 0.0, np.pi / (height - 1), least, ROWS,
              lambda t: (np.sin(t), np.sin(t) ** 2, np.sin(t) * np.cos(t))),
        _axis(width, step / 2, step, 2 * least, 2 * ROWS, lambda p: (np.ones_like(p), np.sin(p), -np.cos(p))),
    )  # fmt: skip


def integrate(image: np.ndarray, latitude: Axis, longitude: Axis) -> np.ndarray:
    """Integrate a map (height, width, 3) over blocks.

    Returns (7, rows, columns): ∫ L dω of the three colours, ∫ w dω and the three components of ∫ w ω dω, with w = Σ |L|
    over the colours and ω in the map's own axes, y up.
    """
    width = image.shape[1]
    result = np.empty((7, len(latitude.first), len(longitude.first)))
    function = [0, 0, 0, 0, 1, 0, 2]
    at, following = (longitude.weights[:, side, function].T for side in (0, 1))
    end = [*latitude.first[1:], len(latitude.texel)]
    for row, pieces in enumerate(map(slice, latitude.first, end)):
        line = latitude.texel[pieces]
        weights = np.zeros((line[-1] - line[0] + 2, 3))
        for side in (0, 1):
            np.add.at(weights, line - line[0] + side, latitude.weights[pieces, side])
        strip = image[line[0] : line[-1] + 2].astype(np.float64).reshape(-1, 3 * width)
        power = (weights[:, 0] @ strip).reshape(width, 3)
        total, across, up = (weights.T @ np.abs(strip)).reshape(3, width, 3) @ np.ones(3)
        values = np.stack([*power.T, total, across, up, across])
        by_piece = at * values.take(longitude.texel, axis=1)
        by_piece += following * values.take(longitude.texel + 1, axis=1, mode="wrap")
        result[:, row] = np.add.reduceat(by_piece, longitude.first, axis=1)
    return result


@dataclass(frozen=True)
class Cells:
    """Parts of the sphere, each of which becomes a directional light.

    axes         latitudes and longitudes of the map that is cut
    bounds       (n, 4) ``Bounds`` of each cell
    power        (n, 3) irradiance, ∫ L dω
    direction    (n, 3) unit vector to the centre of radiance, in the map's own axes
    weight       (n,) integral of the absolute radiance, ∫ w dω with w = Σ |L| over the colours
    focus        (n,) |∫ w ω dω| / weight, which is 1 if all light comes from one point, and 0 if it comes from all
                 sides alike
    solid_angle  (n,) in sr
    """

    axes: tuple[Axis, Axis]
    bounds: np.ndarray
    power: np.ndarray
    direction: np.ndarray
    weight: np.ndarray
    focus: np.ndarray
    solid_angle: np.ndarray

    @property
    def radius(self) -> float:
        """Root mean square angle between light and the direction of its cell, weighted by power, in radians."""
        return float(np.sqrt(2 * (self.weight @ (1 - self.focus)) / max(self.weight.sum(), 1e-300)))

    def error(self, normals: int = 256) -> float:
        """Return a bound of the irradiance's error on unshadowed surfaces, relative to ∫ w dω of the whole sphere.

        It is the largest error over a number of surface `normals`. A cell above the horizon gains
        weight · (1 − focus) · cos. A cell that the horizon may cut loses at most what a distribution with its mean and
        variance can have behind the horizon (Scarf 1958).
        """
        x, z, y = spheres.fibonacci(normals, 0.5).T
        cos = np.stack([x, y, -z], axis=1) @ self.direction.T
        mean, variance = self.focus * np.abs(cos), 1 - self.focus**2
        behind = (np.sqrt(mean**2 + variance) - mean) / 2
        gained = np.maximum(cos, 0) * (1 - self.focus)
        return float(max((behind @ self.weight).max(), (gained @ self.weight).max()) / max(self.weight.sum(), 1e-300))


def cells(image: np.ndarray, limit: int) -> Cells:
    """Cut a map (height, width, 3) into at most `limit` cells, which cover the sphere. The last results are cached."""
    image = np.ascontiguousarray(image)
    key = hashlib.blake2b(image.data).digest(), image.shape, image.dtype.str, limit
    return _cells_of_images.of(key, lambda: _cells(image, limit))


def cells_of(emitter: mi.Emitter, kind: str, limit: int) -> Cells:
    """Return the :func:`cells` of an ``envmap`` or ``constant``."""
    return Version(emitter).once(_cells_of_emitters, lambda: cells(image(emitter, kind), limit), limit)


def _cells(image: np.ndarray, limit: int) -> Cells:
    height, width = image.shape[:2]
    latitude, longitude = axes(height, width, limit)
    blocks = integrate(image, latitude, longitude)
    (a, b, c), (one, sin, cos) = latitude.sums, longitude.sums
    even = np.stack([np.outer(a, one), np.outer(b, sin), np.outer(c, one), np.outer(b, cos)])
    light = blocks[3:] + (FLOOR * blocks[3].sum() / (4 * np.pi) or 1) * even
    bounds = np.array(_cut(light, limit))
    sums, even_sums = (np.array([grid[:, r0:r1, c0:c1].sum(axis=(1, 2)) for r0, r1, c0, c1 in bounds])
                       for grid in (blocks, even))
    weight, length = sums[:, 3], np.linalg.norm(sums[:, 4:], axis=1)
    focus = np.minimum(length / np.where(weight > 0, weight, 1), 1)
    # The direction of a dark cell is its middle. Light from everywhere alike has no centre and comes from above.
    centre = np.where(weight[:, None] > 0, sums[:, 4:] / np.where(weight > 0, weight, 1)[:, None], even_sums[:, 1:])
    length = np.linalg.norm(centre, axis=1)
    direction = np.where((length > 1e-6)[:, None], centre / np.maximum(length, 1e-300)[:, None], [0.0, 1.0, 0.0])
    return Cells((latitude, longitude), bounds, sums[:, :3], direction, weight, focus, even_sums[:, 0])


def _cut(light: np.ndarray, limit: int) -> list[Bounds]:
    """Return the bounds of at most `limit` cells of `light` (4, rows, columns): power and first moments of each block.

    Neighbours follow each other, so that successive lookups use the same lines of the processor's cache.
    """
    order = itertools.count()
    whole_map = (0, light.shape[1], 0, light.shape[2])
    waiting: list[tuple[float, int, str, Bounds]] = [(0.0, next(order), "", whole_map)]
    final: list[tuple[str, Bounds]] = []
    while waiting and len(waiting) + len(final) < limit:
        _, _, path, cell = heapq.heappop(waiting)
        halves = _halves(light, cell)
        if not halves:
            final.append((path, cell))
        for side, (half, (power, *moment)) in enumerate(halves):
            loss = float(power - np.linalg.norm(moment))
            heapq.heappush(waiting, (-loss, next(order), f"{path}{side}", half))
    return [cell for _, cell in sorted(final + [(path, cell) for _, _, path, cell in waiting])]


def _halves(light: np.ndarray, cell: Bounds) -> list[tuple[Bounds, np.ndarray]]:
    """Return the two parts of a cell that its best cut makes, each with its sums; empty for a single block."""
    r0, r1, c0, c1 = cell
    part = light[:, r0:r1, c0:c1]
    best = -1.0
    halves: list[tuple[Bounds, np.ndarray]] = []
    for axis, first in ((2, r0), (1, c0)):
        profile = part.sum(axis=axis)
        if profile.shape[1] == 1:
            continue
        # Summed from both ends, since a difference of sums would lose dim regions beside a sun.
        before = profile.cumsum(axis=1)[:, :-1]
        after = profile[:, ::-1].cumsum(axis=1)[:, ::-1][:, 1:]
        score = np.sqrt((before[1:] ** 2).sum(axis=0)) + np.sqrt((after[1:] ** 2).sum(axis=0))
        at = int(score.argmax())
        if score[at] > best:
            best, cut = float(score[at]), first + at + 1
            bounds = ((r0, cut, c0, c1), (cut, r1, c0, c1)) if axis == 2 else ((r0, r1, c0, cut), (r0, r1, cut, c1))
            halves = list(zip(bounds, (before[:, at], after[:, at]), strict=True))
    return halves


def image(emitter: mi.Emitter, kind: str) -> np.ndarray:
    """Return the texels of an ``envmap`` or ``constant`` in its own axes, (height, width, 3)."""
    if kind == "constant":
        return np.tile(radiance(emitter, np.array([[0.0, 1.0, 0.0]])), (3, 2, 1))
    parameters = mi.traverse(emitter)
    data = np.array(dr.detach(parameters["data"]))[:, 1:-1]  # Mitsuba repeats a column on either side
    return np.asarray(data * np.float32(np.ravel(parameters["scale"])[0]))


def radiance(emitter: mi.Emitter, towards: np.ndarray) -> np.ndarray:
    """Return the radiance (n, 3) that arrives from the scene directions `towards` (n, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(towards))
    si.wi = mi.Vector3f(*(-towards.T).astype(np.float32))
    values = np.array(emitter.eval(si), dtype=np.float64).reshape(3, -1).T
    return np.broadcast_to(values, (len(towards), 3))


def background(emitter: mi.Emitter, d: Vector3) -> Color3:
    """Return the radiance of an environment behind camera rays along the scene directions `d`."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
    si.wi = -d * scale(emitter)
    return emitter.eval(si)


def scale(emitter: mi.Emitter) -> float:
    """Return the scale of an environment's `to_world`, which Mitsuba does not remove from directions of lookups."""
    return placement(emitter, "envmap")[1] if emitter.class_name() == "EnvironmentMapEmitter" else 1.0


def check_unscaled(emitter: mi.Emitter | None) -> None:
    """Raise MiNtfError if an environment's `to_world` scales, since Mitsuba would light surfaces wrongly."""
    if emitter is not None and abs(scale(emitter) - 1) > 1e-3:
        raise MiNtfError(
            f"{name(emitter, 'envmap')}: to_world scales by {scale(emitter):.4g}, under which Mitsuba lights surfaces "
            "wrongly; leave the scale out, an environment has no size"
        )


def placement(emitter: mi.Emitter, kind: str) -> tuple[np.ndarray, float]:
    """Return ``(rotation, scale)`` of an environment's `to_world`.

    The columns of `rotation` are the environment's x, y and z axes in the scene, y being up, also for ``sunsky``, whose
    own z axis is up. It may be a reflection. Raises MiNtfError if `to_world` shears.
    """
    if kind == "constant":
        return np.eye(3), 1.0
    linear = np.array(mi.traverse(emitter)["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    scale = np.sqrt(np.trace(linear.T @ linear) / 3)
    if not scale > 0 or np.abs(linear.T @ linear / scale**2 - np.eye(3)).max() > 1e-3:
        raise MiNtfError(
            f"{name(emitter, kind)}: to_world {np.round(linear, 4).tolist()} is no rotation, reflection or uniform "
            "scale, and Mitsuba samples and looks up such an environment differently; leave the rest out"
        )
    if kind == "sunsky" and abs(scale - 1) > 1e-3:
        raise MiNtfError(
            f"{name(emitter, kind)}: to_world scales by {scale:.4g}, under which Mitsuba moves the sun; leave scale out"
        )
    rotation = linear / scale
    return (rotation[:, [1, 2, 0]] if kind == "sunsky" else rotation), float(scale)


def name(emitter: mi.Emitter, kind: str) -> str:
    """Return the name of an emitter in messages."""
    return f"{kind} emitter ({emitter.id()})" if emitter.id() else f"{kind} emitter"
