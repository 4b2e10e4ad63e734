"""An environment as a few directional lights: exact integrals of its radiance over cells, small where the light is.

Mitsuba's ``envmap`` is bilinear between its texels: their columns are the centres of equal parts of the circle, their
first and last rows the poles. It is integrated exactly over a grid of blocks, and the grid is cut into cells as median
cuts are (Debevec 2005; Viriyothai and Debevec 2009): always the cell that loses most by being one direction, always
where the two halves lose least. Suns and lamps end in cells of their own. A cell's light has its whole power and comes
from its centre of radiance.
"""

import hashlib
import heapq
import itertools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import spheres
from ...core.errors import MiNtfError
from .recent import Recent, Version

ROWS = 512
"""Rows of blocks that a map is summed to at most, and twice as many columns; more only where more lights are wanted."""
FLOOR = 1e-2
"""Share of an even sky that cells are cut by: dark regions too get a few, whose texels then have useful gradients."""
_kept, _kept_of_emitters, _copies = Recent(), Recent(4), Recent(2)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True)
class Axis:
    """Latitudes or longitudes of a map, cut into pieces in which radiance changes linearly, and those put into blocks.

    before   (n,) texel where each piece's interval begins; it ends at the next
    weights  (n, 2, 3): what the radiances of those two texels count in the integral over the piece, times three
             functions of the angle: sin θ, sin² θ, sin θ cos θ of latitudes; 1, sin φ, −cos φ of longitudes
    first    (blocks,) first piece of each
    """

    before: np.ndarray
    weights: np.ndarray
    first: np.ndarray

    @property
    def sums(self) -> np.ndarray:
        """(3, blocks) integrals of the functions."""
        return np.add.reduceat(self.weights.sum(axis=1), self.first).T

    @property
    def block(self) -> np.ndarray:
        """(n,) block of each piece."""
        return np.searchsorted(self.first, np.arange(len(self.before)), side="right") - 1


def _axis(intervals: int, start: float, step: float, least: int, most: int, functions) -> Axis:
    """Intervals of `step` radians from `start` on, in `least` blocks at least and, if that allows, `most` at most."""
    parts = -(-least // intervals)
    piece = np.arange(intervals * parts)
    along = (piece[:, None] % parts + (NODES + 1) / 2) / parts  # (n, nodes), in intervals
    before = piece // parts
    values = np.stack(functions(start + step * (before[:, None] + along)), axis=-1)
    values *= (step / parts / 2 * WEIGHTS)[:, None]
    weights = np.stack([((1 - along)[..., None] * values).sum(1), (along[..., None] * values).sum(1)], axis=1)
    return Axis(before, weights, np.arange(0, len(piece), -(-len(piece) // max(least, most))))


def axes(height: int, width: int, limit: int) -> tuple[Axis, Axis]:
    """Latitudes and longitudes of a map of `height` × `width` texels that is to be cut into up to `limit` cells."""
    least = int(np.ceil(2 * np.sqrt(2 * limit)))  # 16 blocks a cell
    step = 2 * np.pi / width
    return (
        _axis(height - 1, 0.0, np.pi / (height - 1), least, ROWS,
              lambda t: (np.sin(t), np.sin(t) ** 2, np.sin(t) * np.cos(t))),
        _axis(width, step / 2, step, 2 * least, 2 * ROWS, lambda p: (np.ones_like(p), np.sin(p), -np.cos(p))),
    )  # fmt: skip


def integrate(image: np.ndarray, latitude: Axis, longitude: Axis) -> np.ndarray:
    """(7, rows, columns): of each block ∫ L dω, three colours; ∫ w dω and ∫ w ω dω with w = Σ |L| over the colours, and
    ω in the map's own axes, y up. `image`: (height, width, 3)."""
    width = image.shape[1]
    result = np.empty((7, len(latitude.first), len(longitude.first)))
    function = [0, 0, 0, 0, 1, 0, 2]
    at, following = (longitude.weights[:, side, function].T for side in (0, 1))
    last = [*latitude.first[1:], len(latitude.before)]
    for row, pieces in enumerate(map(slice, latitude.first, last)):
        before = latitude.before[pieces]
        weights = np.zeros((before[-1] - before[0] + 2, 3))
        for side in (0, 1):
            np.add.at(weights, before - before[0] + side, latitude.weights[pieces, side])
        strip = image[before[0] : before[-1] + 2].astype(np.float64).reshape(-1, 3 * width)
        power = (weights[:, 0] @ strip).reshape(width, 3)
        total, across, up = (weights.T @ np.abs(strip)).reshape(3, width, 3) @ np.ones(3)
        values = np.stack([*power.T, total, across, up, across])
        by_piece = at * values.take(longitude.before, axis=1)
        by_piece += following * values.take(longitude.before + 1, axis=1, mode="wrap")
        result[:, row] = np.add.reduceat(by_piece, longitude.first, axis=1)
    return result


@dataclass(frozen=True)
class Cells:
    """Parts of the sphere, each a directional light.

    axes       latitudes and longitudes of the map that is cut
    bounds     (n, 4): first and last row and column of blocks, the last not included
    power      (n, 3): irradiance, ∫ L dω
    direction  (n, 3): unit centre of radiance, in the map's own axes
    weight     (n,): ∫ w dω; `focus`: (n,) |∫ w ω dω| / weight, 1 where all light comes from one point
    solid_angle (n,)
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
        """Root mean square of the angle between light and its cell's direction, radians, by power."""
        return float(np.sqrt(2 * (self.weight @ (1 - self.focus)) / max(self.weight.sum(), 1e-300)))

    def error(self, normals: int = 256) -> float:
        """Bound of the irradiance's error on an unshadowed surface, as a share of ∫ w dω, over that many normals.

        A cell above the horizon gains weight · (1 − focus) · cos. One that the horizon may cut loses at most what a
        distribution with its mean and variance can have behind it (Scarf 1958).
        """
        x, z, y = spheres.fibonacci(normals, 0.5).T
        cos = np.stack([x, y, -z], axis=1) @ self.direction.T
        mean, variance = self.focus * np.abs(cos), 1 - self.focus**2
        behind = (np.sqrt(mean**2 + variance) - mean) / 2
        gained = np.maximum(cos, 0) * (1 - self.focus)
        return float(max((behind @ self.weight).max(), (gained @ self.weight).max()) / max(self.weight.sum(), 1e-300))


def cells(image: np.ndarray, limit: int) -> Cells:
    """At most `limit` cells of a map (height, width, 3); they cover the sphere, those without light included. The last
    few are kept."""
    image = np.ascontiguousarray(image)
    key = hashlib.blake2b(image.data).digest(), image.shape, image.dtype.str, limit
    return _kept.of(key, lambda: _cells(image, limit))


def cells_of(emitter, kind: str, limit: int) -> Cells:
    """Return the :func:`cells` of an ``envmap`` or ``constant``."""
    return Version(emitter).once(_kept_of_emitters, lambda: cells(image(emitter, kind), limit), limit)


def _cells(image: np.ndarray, limit: int) -> Cells:
    height, width = image.shape[:2]
    latitude, longitude = axes(height, width, limit)
    blocks = integrate(image, latitude, longitude)
    (a, b, c), (one, sin, cos) = latitude.sums, longitude.sums
    even = np.stack([np.outer(a, one), np.outer(b, sin), np.outer(c, one), np.outer(b, cos)])
    light = blocks[3:] + (FLOOR * blocks[3].sum() / (4 * np.pi) or 1) * even
    bounds = np.array(_cut(light, limit))
    sums = np.array([blocks[:, r0:r1, c0:c1].sum(axis=(1, 2)) for r0, r1, c0, c1 in bounds])
    spread = np.array([even[:, r0:r1, c0:c1].sum(axis=(1, 2)) for r0, r1, c0, c1 in bounds])
    weight, length = sums[:, 3], np.linalg.norm(sums[:, 4:], axis=1)
    focus = np.minimum(length / np.where(weight > 0, weight, 1), 1)
    # A dark cell lies where its middle is. What shines from everywhere alike has no centre and comes from above.
    centre = np.where(weight[:, None] > 0, sums[:, 4:] / np.where(weight > 0, weight, 1)[:, None], spread[:, 1:])
    length = np.linalg.norm(centre, axis=1)
    direction = np.where((length > 1e-6)[:, None], centre / np.maximum(length, 1e-300)[:, None], [0.0, 1.0, 0.0])
    return Cells((latitude, longitude), bounds, sums[:, :3], direction, weight, focus, spread[:, 0])


def power(texels, shape: tuple[int, int], cells: Cells):
    """The power of `cells` as a Color3f that carries the gradients of `texels`: the numbers of a map of that `shape`,
    the repeated column on either side included."""
    latitude, longitude = cells.axes
    owner = np.zeros((len(latitude.first), len(longitude.first)), np.uint32)
    for i, (r0, r1, c0, c1) in enumerate(cells.bounds):
        owner[r0:r1, c0:c1] = i
    # A lane for every pair of pieces: its four texels, times what they count there, belong to one cell.
    column, row = dr.meshgrid(*(dr.arange(mi.UInt32, len(axis.before)) for axis in (longitude, latitude)))

    def of(numbers, index):
        return dr.gather(mi.UInt32, mi.UInt32(numbers.astype(np.uint32)), index)

    def weight(axis, side, index):
        return dr.gather(mi.Float, mi.Float(axis.weights[:, side, 0].astype(np.float32)), index)

    cell = of(owner.ravel(), of(latitude.block * owner.shape[1], row) + of(longitude.block, column))
    corners = []
    for down, right in itertools.product((0, 1), repeat=2):
        texel = of((latitude.before + down) * shape[1], row)
        texel += of((longitude.before + right) % (shape[1] - 2) + 1, column)
        corners.append((weight(latitude, down, row) * weight(longitude, right, column), texel))
    total = [dr.zeros(mi.Float, len(cells.bounds)) for _ in range(3)]
    for i, channel in enumerate(total):
        value = sum(share * dr.gather(mi.Float, texels, 3 * texel + i) for share, texel in corners)
        dr.scatter_add(channel, value, cell)
    return mi.Color3f(*total)


def _cut(light: np.ndarray, limit: int) -> list:
    """Bounds of at most `limit` cells of `light` (4, rows, columns): power and first moments of each block. Neighbours
    follow each other, so that lookups find in the processor's cache what the light before needed."""
    order = itertools.count()
    waiting = [(0.0, next(order), "", (0, light.shape[1], 0, light.shape[2]))]
    whole: list = []
    while waiting and len(waiting) + len(whole) < limit:
        _, _, path, cell = heapq.heappop(waiting)
        halves = _halves(light, cell)
        if not halves:
            whole.append((path, cell))
        for side, (half, (power, *moment)) in enumerate(halves):
            heapq.heappush(waiting, (np.linalg.norm(moment) - power, next(order), f"{path}{side}", half))
    return [cell for _, cell in sorted(whole + [(path, cell) for _, _, path, cell in waiting])]


def _halves(light: np.ndarray, cell: tuple) -> list:
    """The two parts of a cell, each with its sums, that its best cut makes; none of a single block."""
    r0, r1, c0, c1 = cell
    part = light[:, r0:r1, c0:c1]
    best, found = -1.0, []
    for axis, first in ((2, r0), (1, c0)):
        profile = part.sum(axis=axis)
        if profile.shape[1] == 1:
            continue
        # From both ends: a difference of sums would lose what is dim beside a sun.
        before = profile.cumsum(axis=1)[:, :-1]
        after = profile[:, ::-1].cumsum(axis=1)[:, ::-1][:, 1:]
        score = np.sqrt((before[1:] ** 2).sum(axis=0)) + np.sqrt((after[1:] ** 2).sum(axis=0))
        at = int(score.argmax())
        if score[at] > best:
            best, cut = float(score[at]), first + at + 1
            bounds = ((r0, cut, c0, c1), (cut, r1, c0, c1)) if axis == 2 else ((r0, r1, c0, cut), (r0, r1, cut, c1))
            found = list(zip(bounds, (before[:, at], after[:, at]), strict=True))
    return found


def image(emitter, kind: str) -> np.ndarray:
    """(height, width, 3) texels of an ``envmap`` or ``constant`` in its own axes."""
    if kind == "constant":
        return np.tile(radiance(emitter, np.array([[0.0, 1.0, 0.0]])), (3, 2, 1))
    parameters = mi.traverse(emitter)
    data = np.array(dr.detach(parameters["data"]))[:, 1:-1]  # Mitsuba repeats a column on either side
    return data * np.float32(np.ravel(parameters["scale"])[0])


def radiance(emitter, towards: np.ndarray) -> np.ndarray:
    """(n, 3) radiance that arrives from the scene directions `towards` (n, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(towards))
    si.wi = mi.Vector3f(*(-towards.T).astype(np.float32))
    found = np.array(emitter.eval(si), dtype=np.float64).reshape(3, -1).T
    return np.broadcast_to(found, (len(towards), 3))


def drawable(emitter):
    """Return an emitter of the same light whose own sampling finds all of it.

    It is `emitter` itself, unless that is an ``envmap`` with `mis_compensation` (Karlík et al. 2019): this one never
    samples the light below its mean, which is left to BSDF samples. Points of fields have emitter samples alone, so a
    copy without `mis_compensation` is returned."""
    if emitter.class_name() != "EnvironmentMapEmitter":
        return emitter
    copy = Version(emitter).once(_copies, lambda: _uncompensated(emitter) if _is_compensated(emitter) else None)
    return copy or emitter


PROBES = 64
"""Rows and columns of an environment, at most, at which its sampling density is looked up."""


def _is_compensated(emitter) -> bool:
    """Return True if the sampling density of an ``envmap`` is not in proportion to its luminance.

    At the centres of texels it is, to rounding, unless `mis_compensation` has subtracted the mean luminance. The
    density is then 0 wherever the luminance is below the mean, so any threshold between 0 and 1 separates the two."""
    height, width = mi.traverse(emitter)["data"].shape[:2]
    row, column = (np.unique(np.linspace(a, n - 1 - a, PROBES).astype(int)) for a, n in ((1, height), (0, width - 2)))
    theta, phi = np.meshgrid(row * np.pi / (height - 1), (column + 0.5) * 2 * np.pi / (width - 2), indexing="ij")
    own = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], -1).reshape(-1, 3)
    towards = own @ placement(emitter, "envmap")[0].T
    luminance = radiance(emitter, towards * scale(emitter)) @ [0.212671, 0.715160, 0.072169]
    ds = dr.zeros(mi.DirectionSample3f, len(towards))
    ds.d = mi.Vector3f(*(towards * scale(emitter)).T.astype(np.float32))
    density = np.array(emitter.pdf_direction(dr.zeros(mi.Interaction3f, len(towards)), ds), np.float64)
    lit = luminance > 1e-3 * luminance.max()
    ratio = density[lit] / luminance[lit]
    return bool(lit.any() and ratio.min() < 0.5 * ratio.max())


def _uncompensated(emitter):
    """Return an ``envmap`` of the same parameters, without `mis_compensation`."""
    copy = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))})
    ours, theirs = mi.traverse(copy), mi.traverse(emitter)
    for key in ("data", "scale", "to_world"):
        ours[key] = theirs[key]
    ours.update()
    return copy


def seen(emitter, d):
    """Color3f that camera rays along the scene directions `d` see of an environment."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
    si.wi = -d * scale(emitter)
    return emitter.eval(si)


def scale(emitter) -> float:
    """Return the scale of an environment's `to_world`, which Mitsuba leaves in the directions that it looks up."""
    return placement(emitter, "envmap")[1] if emitter.class_name() == "EnvironmentMapEmitter" else 1.0


def check_unscaled(emitter) -> None:
    """Raises MiNtfError where an environment's `to_world` scales, before Mitsuba itself lights surfaces by it."""
    if emitter is not None and abs(scale(emitter) - 1) > 1e-3:
        raise MiNtfError(
            f"{name(emitter, 'envmap')}: to_world scales by {scale(emitter):.4g}, under which Mitsuba lights surfaces "
            "wrongly; leave the scale out, an environment has no size"
        )


def placement(emitter, kind: str) -> tuple[np.ndarray, float]:
    """``(rotation, scale)``: columns of `rotation` are the environment's x, y and z axes in the scene, y being up
    (``sunsky`` has z up); it may be a reflection. Raises MiNtfError where `to_world` shears."""
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


def name(emitter, kind: str) -> str:
    """Display name used in error messages."""
    return f"{kind} emitter ({emitter.id()})" if emitter.id() else f"{kind} emitter"
