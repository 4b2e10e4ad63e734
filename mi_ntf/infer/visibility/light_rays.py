"""The m² rays of a light for which maps and volumes store transmittance, and the four of them nearest to a point.

A light that sees the whole object within 63° of its axis has the rays through a rectangle on the plane through the
origin perpendicular to the axis. It is the smallest of a few rectangles that hold the object's outline, cut into at
most m² square cells. Parallel rays are the limit of a distant light, so both are one case. A light near the object or
inside it looks everywhere: its m × m rays are octahedral (Engelhardt and Dachsbacher 2008).

    û, v̂     unit vectors across, times cells per field unit
    k, axis  1/(distance of the light from the origin), 0 for directional lights; unit vector from the light to there
    f        place in the table, in cells: fu = ⟨û, x⟩/depth + u0, depth = 1 + k ⟨axis, x⟩; likewise fv
"""

import itertools
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import NamedTuple, TypeAlias

import drjit as dr
import numpy as np

from ...core.ops import cross, dot
from .. import octahedral
from ..backend import floats
from ..lights import LightTable
from ..types import Array, Float, Mask, UInt32, Vector

ROW, COLUMNS, KIND = 16, 11, 15
"""Numbers in a row of :class:`Light`, and the positions of its `columns` and its `kind`."""
PART = 128
"""Lights whose rectangles are searched at a time, so that the arrays stay in the processor's cache."""
NEAREST_DEPTH = 0.2
"""Least depth of the object, as defined above (1 at the origin), for a light that has a rectangle."""
WIDEST = 2.0
"""Largest tangent of the angle of a ray to the axis, tan 63°; wider frusta waste their rays on the rim."""
DIRECTIONAL, FRUSTUM, SPHERE = 0.0, 1.0, 2.0
"""Kinds of lights: parallel rays, rays through a rectangle, rays in all directions."""


class Light(NamedTuple):
    """A light's row: û, u0, v̂, v0, k · axis, cells along u; position and kind if requested."""

    u: Vector
    u0: Float
    v: Vector
    v0: Float
    axis: Vector
    columns: Float
    position: Array = None
    kind: Array = None


class Place(NamedTuple):
    """Place of a point in a light's table.

    `f`: coordinates in cells; `inside`: the point is in the table; `depth`: as above; `projected`: ⟨û, x⟩ and ⟨v̂, x⟩;
    `sphere`: the light looks everywhere (None if no light of the table does).
    """

    f: tuple[Float, Float]
    inside: Mask
    depth: Float
    projected: tuple[Float, Float]
    sphere: Mask = None


Corner: TypeAlias = tuple[Float, UInt32, Float]
"""Bilinear weight, index of a texel, and place t' on its ray."""


class LightRays:
    """Rays of all lights of a table, at most `resolution`² rays a light.

    `hull` (k, 3): points whose convex hull holds all density. `parallel`: all lights are directional; `full`: a light
    looks everywhere. Kernels depend on both.
    """

    def __init__(self, lights: LightTable, hull: np.ndarray, resolution: int, dj: ModuleType):
        self.dj, self.m, self.count = dj, resolution, lights.count
        rows = frames(lights, hull, resolution)
        self.parallel, self.full = not (rows[:, KIND] > 0).any(), bool((rows[:, KIND] == SPHERE).any())
        self._rows = floats(rows, dj)
        self._texels = dr.opaque(dj.UInt32, resolution**2)
        self._area = dr.opaque(dj.Float, resolution**2 + 0.5)

    def _side(self) -> Float:
        """Return the number of cells along a side of the directions of lights that look everywhere."""
        return dr.sqrt(dr.floor(self._area))

    def one(self, index: UInt32, x: Vector, u: Sequence[Float]) -> tuple[Mask, UInt32]:
        """Return ``(inside, texel)`` of one of the four rays of directional light `index` nearest to `x`.

        It is sampled by its bilinear weight with the uniform numbers `u` (2).
        """
        first = self.dj.UInt32(index) * (ROW // 4)
        axes = (dr.gather(self.dj.Array4f, self._rows, first + i) for i in range(2))
        fu, fv = (dot((c[0], c[1], c[2]), x) + c[3] for c in axes)
        columns = dr.gather(self.dj.Float, self._rows, first * 4 + COLUMNS)
        lines = dr.floor(self._area / columns)
        inside = (fu > -0.5) & (fv > -0.5) & (fu < columns - 0.5) & (fv < lines - 0.5)
        tu, tv = (dr.clip(dr.floor(f + r), 0, n - 1) for f, r, n in ((fu, u[0], columns), (fv, u[1], lines)))
        return inside, self.dj.UInt32(index) * self._texels + self.dj.UInt32(tv * columns + tu)

    def light(self, index: UInt32, active: Mask, place: bool = True) -> Light:
        """Return the row of light `index`, with position and kind if `place`."""
        first = self.dj.UInt32(index) * (ROW // 4)
        u, v, axis = (dr.gather(self.dj.Array4f, self._rows, first + i, active) for i in range(3))
        row = Light((u[0], u[1], u[2]), u[3], (v[0], v[1], v[2]), v[3], (axis[0], axis[1], axis[2]), axis[3])
        if place:
            last = dr.gather(self.dj.Array4f, self._rows, first + 3, active)
            row = row._replace(position=(last[0], last[1], last[2]), kind=last[3])
        return row

    def lines(self, light: Light) -> Float:
        """Return the number of cells along v."""
        return dr.floor(self._area / light.columns)

    def ray(self, light: Light, tu: Float, tv: Float) -> tuple[Vector, Vector, Float]:
        """Return ``(o, d, end)`` of the ray through the centre of cell (tu, tv).

        They are a point on the ray, its direction towards the light, and the light's place t' on it, infinite for
        directional lights.
        """
        u2, v2 = dot(light.u, light.u), dot(light.v, light.v)
        su, sv = (tu - light.u0) / u2, (tv - light.v0) / v2
        o = tuple(su * a + sv * b for a, b in zip(light.u, light.v, strict=True))
        k2 = dot(light.axis, light.axis)
        towards = cross(light.u, light.v)  # along the axis, of length |û||v̂|
        scale = dr.rsqrt(u2 * v2)
        out = tuple(scale * a + dr.sqrt(k2) * c for a, c in zip(towards, o, strict=True))
        norm = dr.rsqrt(dot(out, out))
        d = tuple(-c * norm for c in out)
        if self.full:
            sphere = light.kind == SPHERE
            around = octahedral.direction(tu, tv, self._side())
            d = tuple(dr.select(sphere, -a, b) for a, b in zip(around, d, strict=True))
            o = tuple(dr.select(sphere, a, b) for a, b in zip(light.position, o, strict=True))
        return o, d, dr.select(light.kind == DIRECTIONAL, dr.inf, dot(light.position, d))

    def all_rays(self, first: int, count: int) -> tuple[UInt32, Vector, Vector, Float]:
        """Return ``(texel, o, d, end)`` of every ray of the lights `first` … `first + count` − 1, in table order."""
        texels = self.m**2
        texel = dr.arange(self.dj.UInt32, count * texels) + dr.opaque(self.dj.UInt32, first * texels)
        number = texel // self._texels
        light = self.light(number, True)
        # Idle lanes of the last packet gather zeros, and integers must not be divided by 0.
        rest, columns = texel - number * self._texels, dr.maximum(self.dj.UInt32(light.columns), 1)
        line = rest // columns
        return texel, *self.ray(light, self.dj.Float(rest - line * columns), self.dj.Float(line))

    def nearest(self, index: UInt32, x: Vector, wi: Vector, distance: Float,
                active: Mask) -> tuple[Mask, Float, list[Corner]]:
        """Return the four rays of light `index` nearest to `x`.

        Returns
        -------
        inside
            True where light towards `x` can meet the object at all.
        size
            Distance of neighbouring rays at `x`, field units.
        corners
            For each ray its weight, its texel, counted through the tables of all lights, and t' where the plane through
            `x` perpendicular to ω_i cuts it.
        """
        light = self.light(index, active, self.full)
        place = self._place(light, x, wi, active)
        size = place.depth * dr.rsqrt(dot(light.u, light.u))
        if self.full:
            size = dr.select(place.sphere, 3.5 * distance / light.columns, size)  # √(4π)/m radians
        corners = self._corners(light, place, x, wi, distance)
        base, width = self.dj.UInt32(index) * self._texels, self.dj.UInt32(light.columns)
        return place.inside, size, [
            (weight, base + self.dj.UInt32(tv) * width + self.dj.UInt32(tu), t) for weight, tu, tv, t in corners]

    def _place(self, light: Light, x: Vector, wi: Vector, active: Mask) -> Place:
        """Return the place of `x` in the table of `light`."""
        projected = dot(light.u, x), dot(light.v, x)
        depth: Float = 1 if self.parallel else 1 + dot(light.axis, x)
        inverse = 1 if self.parallel else dr.rcp(dr.maximum(depth, NEAREST_DEPTH / 2))
        fu, fv = projected[0] * inverse + light.u0, projected[1] * inverse + light.v0
        inside = active & (fu > -0.5) & (fv > -0.5) & (fu < light.columns - 0.5) & (fv < self.lines(light) - 0.5)
        if not self.parallel:
            inside &= depth > NEAREST_DEPTH / 2
        if not self.full:
            return Place((fu, fv), inside, depth, projected)
        sphere = light.kind == SPHERE
        su, sv = octahedral.place(tuple(-c for c in wi), self._side())
        f = dr.select(sphere, su, fu), dr.select(sphere, sv, fv)
        return Place(f, inside | (active & sphere), depth, projected, sphere)

    def _corners(self, light: Light, place: Place, x: Vector, wi: Vector,
                 distance: Float) -> list[tuple[Float, Float, Float, Float]]:
        """Return ``(weight, column, line, t)`` of the four cells around `place`."""
        (fu, fv), along = place.f, dot(x, wi)
        iu, iv = dr.floor(fu), dr.floor(fv)
        wu, wv = fu - iu, fv - iv
        u = dr.maximum(iu, 0), dr.minimum(iu + 1, light.columns - 1)
        v = dr.maximum(iv, 0), dr.minimum(iv + 1, self.lines(light) - 1)
        frustum_t = None if self.parallel else self._frustum_place(light, x, wi, distance, place, along)
        corners = []
        for j, i in itertools.product((0, 1), repeat=2):
            tu, tv, t = u[i], v[j], frustum_t(u[i], v[j]) if frustum_t else along
            if self.full:
                around = octahedral.wrap(iu + i, iv + j, self._side())
                t = dr.select(place.sphere, self._sphere_place(x, wi, distance, *around), t)
                tu, tv = (dr.select(place.sphere, a, b) for a, b in zip(around, (tu, tv), strict=True))
            corners.append(((wu if i else 1 - wu) * (wv if j else 1 - wv), tu, tv, t))
        return corners

    def _frustum_place(self, light: Light, x: Vector, wi: Vector, distance: Float, place: Place,
                       along: Float) -> Callable[[Float, Float], Float]:
        """Return t of the ray through cell (tu, tv), as a function.

        The ray's direction is ω_i + g, normalised, with g across: −(δu û/û² + δv v̂/v̂²) · depth/r, δ the distance in
        cells. It is written in differences from ω_i, so that a light 10⁴ radii away keeps all its digits: coordinates
        on the ray, ⟨light, d⟩ − r/⟨d, ω_i⟩, would lose four.
        """
        f, depth, projected = place.f, place.depth, place.projected
        kappa = depth / distance  # 0 for directional lights
        u2, v2 = dr.rcp(dot(light.u, light.u)), dr.rcp(dot(light.v, light.v))
        pu, pv = projected[0] * u2, projected[1] * v2
        qu, qv = dot(light.u, wi) * u2, dot(light.v, wi) * v2

        def t(tu: Float, tv: Float) -> Float:
            du, dv = tu - f[0], tv - f[1]
            xg, wg = kappa * (du * pu + dv * pv), du * qu + dv * qv
            g2 = du * du * u2 + dv * dv * v2
            drop = kappa * depth * (g2 - wg * wg) * dr.rcp(1 - kappa * wg)
            return (along - xg - drop) * dr.rsqrt(1 + kappa * (kappa * g2 - 2 * wg))

        return t

    def _sphere_place(self, x: Vector, wi: Vector, distance: Float, tu: Float, tv: Float) -> Float:
        """Return t of the ray in direction (tu, tv) of a light that looks everywhere."""
        d = tuple(-c for c in octahedral.direction(tu, tv, self._side()))
        cosine = dr.maximum(dot(d, wi), 0.1)
        return dot(x, d) - distance * (1 - cosine * cosine) / cosine


def frames(lights: LightTable, hull: np.ndarray, resolution: int) -> np.ndarray:
    """Return the rows of :class:`Light`, (n, 16) float64."""
    distance = np.maximum(np.linalg.norm(lights.where, axis=1), 1e-9)
    axis = -lights.where / distance[:, None]
    k = np.where(lights.is_point, 1 / distance, 0.0)
    depth = 1 + k * _along(hull, axis)  # (hull points, n)
    helper = np.where(np.abs(axis[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(axis, helper)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    up = np.cross(axis, side)
    scale = np.maximum(depth, NEAREST_DEPTH)
    chunks = [slice(i, i + PART) for i in range(0, max(lights.count, 1), PART)]
    best = np.concatenate([_rectangles(side[s], up[s], hull, scale[:, s]) for s in chunks])
    u, v, (u_middle, u_half, v_middle, v_half) = best[:, :3], best[:, 3:6], best[:, 6:].T
    widest = k * np.maximum(np.abs(u_middle) + u_half, np.abs(v_middle) + v_half)
    sphere = (depth.min(0) < NEAREST_DEPTH) | (widest > WIDEST)
    columns = np.clip(np.round(resolution * np.sqrt(u_half / v_half)), 2, resolution**2 // 2)
    columns = np.where(sphere, resolution, columns)
    lines = np.floor((resolution**2 + 0.5) / columns)
    su, sv = columns / (2 * u_half), lines / (2 * v_half)
    u0, v0 = columns / 2 - 0.5 - su * u_middle, lines / 2 - 0.5 - sv * v_middle
    position = np.where(lights.is_point[:, None], lights.where, 0.0)
    kind = np.where(sphere, SPHERE, np.where(lights.is_point, FRUSTUM, DIRECTIONAL))
    parts = (su[:, None] * u, u0, sv[:, None] * v, v0, k[:, None] * axis, columns, position, kind)
    return np.concatenate([p.reshape(lights.count, -1) for p in parts], axis=1)


def _along(points: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return ⟨point, axis⟩, (points, axes), rounded independently of their number, unlike a product of matrices."""
    result: np.ndarray = sum(points[:, i, None] * axes[None, :, i] for i in range(3))
    return result


def _rectangles(side: np.ndarray, up: np.ndarray, hull: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the smallest of a few rectangles that hold the object as each light sees it, (n, 10).

    A row is û and v̂ of unit length and both :func:`_window`. `side`, `up`: (n, 3), axes perpendicular to the light's;
    `scale`: depth of the `hull`, (points, n).
    """
    x, y = _along(hull, side) / scale, _along(hull, up) / scale
    best, area = np.zeros((len(side), 10)), np.full(len(side), np.inf)
    for angle in np.arange(8) * np.pi / 16:
        c, s = np.cos(angle), np.sin(angle)
        row = np.concatenate([c * side + s * up, c * up - s * side, _window(c * x + s * y), _window(c * y - s * x)], 1)
        size = row[:, 7] * row[:, 9]
        # By a clear margin, since rounding would choose among equal rectangles.
        smaller = size < (1 - 1e-6) * area
        best, area = np.where(smaller[:, None], row, best), np.where(smaller, size, area)
    return best


def _window(places: np.ndarray) -> np.ndarray:
    """Return middle and half width, (n, 2), of the interval that holds all `places` (points, n)."""
    low, high = places.min(0), places.max(0)
    return np.stack([(low + high) / 2, np.maximum((high - low) / 2, 1e-3)], axis=1)
