"""The transmittance map: per light, a 2-D table of the logistic's (a, b) (method.md, section 6; Shafiei et al. 2021,
section 3.3, with the slips of its algorithms corrected).

A light's rays: parallel (directional) or through a pinhole at the light (point). The map is the smallest of a few
rectangles around the object as the light sees it, cut into at most m² square texels: as many as a map of m × m, where
they serve best. A texel holds (a, b) of the ray through its centre, towards the light. A lookup evaluates the four
nearest rays and interpolates the four τ bilinearly, never (a, b).
"""

from types import ModuleType

import drjit as dr
import numpy as np

from ...core import logistic, spheres
from ...core.errors import MiNtfError
from ...core.ops import dot
from .. import ops
from ..lights import LightTable
from ..march import clear_distance, safe_inverse

_ROW = 18


class TransmittanceMap:
    """Maps of all lights of a table, m² texels each, in one Dr.Jit texture of (a, b), layer upon layer.

    `fit(o, d) → (a, b)` solves the logistic of rays through `o` towards the light along `d`. `hull` (k, 3): points
    whose convex hull holds all density, inside a ball of `radius`. Memory: 8 m² bytes a light.
    """

    def __init__(self, lights: LightTable, resolution: int, hull: np.ndarray, fit, dj: ModuleType):
        self.dj, self.m, self.count = dj, resolution, lights.count
        self._rows = dj.Float(_frames(lights, hull, resolution).astype(np.float32).ravel())
        self.texture = self._build(fit)

    def tau(self, x, wi, distance, index, active):
        """Bilinear τ of the four nearest texel rays; 1 outside the map."""
        light = self._light(index, active)
        axis, u, v, position, window, point, columns = light
        lines = self._lines(columns)
        rel = tuple(a - point * b for a, b in zip(x, position, strict=True))
        depth = dr.select(point > 0, dr.maximum(dot(rel, axis), 1e-6), 1)
        inverse = dr.rcp(depth)
        fu = ((dot(rel, u) * inverse - window[0]) / window[2] * 0.5 + 0.5) * columns - 0.5
        fv = ((dot(rel, v) * inverse - window[1]) / window[3] * 0.5 + 0.5) * lines - 0.5
        inside = active & (fu > -0.5) & (fv > -0.5) & (fu < columns - 0.5) & (fv < lines - 0.5)
        iu, iv = dr.floor(fu), dr.floor(fv)
        wu, wv = fu - iu, fv - iv
        result = 0
        for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
            tu, tv = dr.clip(iu + du, 0, columns - 1), dr.clip(iv + dv, 0, lines - 1)
            a, b = self._fetch(index, columns, tu, tv, inside)
            t = self._coordinate(light, x, wi, tu, tv)
            weight = (wu if du else 1 - wu) * (wv if dv else 1 - wv)
            result += weight * logistic.transmittance(ops, t, a, b)
        return dr.select(inside, result, 1)

    def _lines(self, columns):
        return dr.floor((self.m * self.m + 0.5) / columns)

    def _fetch(self, index, columns, tu, tv, active):
        uint = self.dj.UInt32
        texel = uint(index) * (self.m * self.m) + uint(tv) * uint(columns) + uint(tu)
        pair = dr.gather(self.dj.Array2f, self.texture.tensor().array, texel, active)
        return pair[0], pair[1]

    def _light(self, index, active):
        """Axis away from the light, two vectors across, position, window (centre u, v; half width u, v), point flag,
        texels along u."""
        base = self.dj.UInt32(index) * _ROW
        row = [dr.gather(self.dj.Float, self._rows, base + i, active) for i in range(_ROW)]
        return tuple(row[0:3]), tuple(row[3:6]), tuple(row[6:9]), tuple(row[9:12]), tuple(row[12:16]), row[16], row[17]

    def _ray(self, light, tu, tv):
        """A point of the ray through texel (tu, tv)'s centre, and its direction towards the light."""
        axis, u, v, position, window, point, columns = light
        su = ((tu + 0.5) * (2 / columns) - 1) * window[2] + window[0]
        sv = ((tv + 0.5) * (2 / self._lines(columns)) - 1) * window[3] + window[1]
        offset = tuple(su * a + sv * b for a, b in zip(u, v, strict=True))
        out = tuple(a + point * c for a, c in zip(axis, offset, strict=True))
        norm = dr.rsqrt(dot(out, out))
        origin = tuple(dr.select(point > 0, p, c) for p, c in zip(position, offset, strict=True))
        return origin, tuple(-c * norm for c in out)

    def _coordinate(self, light, x, wi, tu, tv):
        """t' on the texel's ray where the plane through x perpendicular to ω_i cuts it."""
        origin, d = self._ray(light, tu, tv)
        rel = tuple(a - b for a, b in zip(x, origin, strict=True))
        return dot(origin, d) + dot(rel, wi) / dr.maximum(dot(d, wi), 1e-3)

    def _build(self, fit):
        texels = self.m * self.m
        values = dr.zeros(self.dj.Float, 2 * texels * self.count)
        # A chunk of lights at a time bounds what a map source holds per ray.
        chunk = max(1, (1 << 22) // texels)
        for first in range(0, self.count, chunk):
            n = min(chunk, self.count - first)
            i = dr.arange(self.dj.UInt32, n * texels) + dr.opaque(self.dj.UInt32, first * texels)
            light = self._light(i // texels, True)
            rest, columns = i % texels, self.dj.UInt32(light[6])
            origin, d = self._ray(light, self.dj.Float(rest % columns), self.dj.Float(rest // columns))
            a, b = fit(origin, d)
            dr.scatter(values, self.dj.Array2f(a, b), i)
            dr.eval(values)
        tensor = self.dj.TensorXf(values, (self.count * self.m, self.m, 2))
        return self.dj.Texture2f(tensor, use_accel=False, filter_mode=dr.FilterMode.Nearest)


def _frames(lights: LightTable, hull: np.ndarray, resolution: int) -> np.ndarray:
    """The rows of :meth:`TransmittanceMap._light`, (n, 18) float64."""
    distance = np.linalg.norm(lights.where, axis=1)
    radius = np.linalg.norm(hull, axis=1).max()
    near = lights.is_point & (distance <= radius * 1.001)
    if near.any():
        raise MiNtfError(
            f"transmittance_map: point light {int(np.argmax(near))} lies inside the captured object's bounding "
            f"sphere ({distance[near][0]:.3g} of {radius:.3g} field units from its centre), where a frustum map "
            "cannot cover it; move the light out or use visibility=raymarch or neural_transmittance"
        )
    axis = -lights.where / distance[:, None]
    helper = np.where(np.abs(axis[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(axis, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(axis, side)
    best, area = None, np.full(lights.count, np.inf)
    for angle in np.arange(8) * np.pi / 16:
        u = np.cos(angle) * side + np.sin(angle) * up
        v = np.cos(angle) * up - np.sin(angle) * side
        window = _window(lights, axis, u, v, hull)
        row = np.concatenate([u, v, window], axis=1)
        size = window[:, 2] * window[:, 3]
        best = row if best is None else np.where((size < area)[:, None], row, best)
        area = np.minimum(area, size)
    position = np.where(lights.is_point[:, None], lights.where, 0.0)
    columns = np.clip(np.round(resolution * np.sqrt(best[:, 8:9] / best[:, 9:10])), 2, resolution**2 // 2)
    return np.concatenate([axis, best[:, :6], position, best[:, 6:], lights.is_point[:, None], columns], axis=1)


def _window(lights: LightTable, axis, u, v, hull) -> np.ndarray:
    """Centre and half width, along u and v, of the rectangle that holds `hull` as each light sees it: (n, 4)."""
    rows = []
    for along in (u, v):
        place = hull @ along.T  # (k, n)
        offset = np.where(lights.is_point, (lights.where * along).sum(1), 0.0)
        away = np.where(lights.is_point, hull @ axis.T - (lights.where * axis).sum(1), 1.0)
        place = (place - offset) / away
        low, high = place.min(0), place.max(0)
        rows.append(((low + high) / 2, np.maximum((high - low) / 2, 1e-3)))
    return np.stack([rows[0][0], rows[1][0], rows[0][1], rows[1][1]], axis=1)


def network_source(field):
    """`map_source=network`: (a, b) by one query of the ray network; τ = 1 where the ray misses the sphere."""

    def fit(o, d):
        hit, _m, _h, a, b = field.transmittance_parameters(o, d)
        return dr.select(hit, a, 1), dr.select(hit, b, CLEAR)

    return fit


CLEAR = -100.0
"""b of a ray that nothing blocks: S(1·(t + 100)) = 1 in float32 for every t of the sphere."""


def field_source(density, grid, step):
    """`map_source=field`: march the field once per ray, from the light inwards, and solve (a, b) in closed form."""

    def fit(o, d):
        hit, m, h = spheres.chord(ops, o, d)
        back = tuple(-c for c in d)
        inverse = safe_inverse(back)
        floats = type(o[0])
        n = dr.width(h)
        levels = [dr.log(4 / 3), dr.log(2.0), dr.log(4.0)]

        def body(s, depth, first, c0, c1, c2, active):
            p = tuple(mi + (h - s - 0.5 * step) * di for mi, di in zip(m, d, strict=True))
            skip = clear_distance(grid, p, inverse)
            empty = skip > 0
            sigma = dr.select(active & ~empty, density(p), 0)
            after = depth + sigma * step
            rate = dr.rcp(dr.maximum(sigma, 1e-6))
            crossings = [
                dr.select((depth < q) & (after >= q), s + (q - depth) * rate, c)
                for c, q in zip((c0, c1, c2), levels, strict=True)
            ]
            first = dr.select((depth == 0) & (after > 0), s, first)
            s = s + dr.select(empty, skip + 1e-4, step)
            return s, after, first, *crossings, active & (s < 2 * h) & (after < levels[2])

        zero = dr.zeros(floats, n)
        state = (zero, floats(zero), floats(zero), floats(zero), floats(zero), floats(zero), dr.mask_t(floats)(hit))
        _s, depth, first, c0, c1, c2, _ = dr.while_loop(
            state=state, cond=lambda s, depth, first, c0, c1, c2, active: active, body=body, label="map march"
        )
        a, b = logistic.through_quantiles(ops, h - c0, h - c1, h - c2)
        a_part, b_part = _partial(h, first, depth)
        blocked, clear = depth >= levels[2], ~hit | (depth < 1e-3)
        a, b = dr.select(blocked, a, a_part), dr.select(blocked, b, b_part)
        return dr.select(clear, 1, a), dr.select(clear, CLEAR, b)

    return fit


def _partial(h, first, depth):
    """(a, b) of a ray that keeps p = e^−depth > 1/4 of the light: a logistic cannot rest at p, so it passes (1 + p)/2
    where the matter begins and p halfway from there to the far end."""
    p = dr.exp(-depth)
    top, low = dr.log((1 + p) / dr.maximum(1 - p, 1e-4)), dr.log(p / dr.maximum(1 - p, 1e-4))
    begin = h - first
    a = (top - low) / dr.maximum(0.5 * (begin + h), 1e-2)
    return a, begin - top / a
