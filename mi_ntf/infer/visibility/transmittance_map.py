"""The transmittance map: per light, a 2-D table of the logistic's (a, b), or of a mixture of logistics (method.md,
section 6; Shafiei et al. 2021, section 3.3, with the slips of its algorithms corrected).

A light's rays: parallel (directional) or through a pinhole at the light (point). The map is the smallest of a few
rectangles around the object as the light sees it, cut into at most m² square texels: as many as a map of m × m, where
they serve best. A texel holds (a, b) of the ray through its centre, towards the light. A lookup evaluates the four
nearest rays and interpolates the four τ bilinearly, never (a, b).
"""

import math
from types import ModuleType

import drjit as dr
import numpy as np

from ...core import logistic, mixture, spheres
from ...core.errors import MiNtfError
from ...core.ops import dot
from .. import ops
from ..lights import LightTable

_ROW = 18


def channels(components: int) -> int:
    """float32 numbers a texel: (a, b), or (w, a, b, 0) for each logistic of a mixture."""
    return 2 if components == 1 else 4 * components


class TransmittanceMap:
    """Maps of all lights of a table, m² texels each, in one Dr.Jit texture of mixtures, layer upon layer.

    `source`: ``(fit, K)``; `fit(o, d)` solves the mixture of K logistics of rays through `o` towards the light along
    `d`. `hull` (k, 3): points whose convex hull holds all density. Memory: 8 m² bytes a light for one logistic, whose
    weight is 1 and not stored, 16 K m² for mixtures.
    """

    def __init__(self, lights: LightTable, resolution: int, hull: np.ndarray, source, dj: ModuleType):
        fit, self.components = source
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
            mix = self._fetch(index, columns, tu, tv, inside)
            t = self._coordinate(light, x, wi, tu, tv)
            weight = (wu if du else 1 - wu) * (wv if dv else 1 - wv)
            result += weight * mixture.transmittance(ops, t, mix)
        return dr.select(inside, result, 1)

    def _lines(self, columns):
        return dr.floor((self.m * self.m + 0.5) / columns)

    def _fetch(self, index, columns, tu, tv, active):
        uint = self.dj.UInt32
        texel = uint(index) * (self.m * self.m) + uint(tv) * uint(columns) + uint(tu)
        values = self.texture.tensor().array
        if self.components == 1:
            return ((1.0, *dr.gather(self.dj.Array2f, values, texel, active)),)
        first = texel * self.components
        rows = [dr.gather(self.dj.Array4f, values, first + k, active) for k in range(self.components)]
        return tuple((row[0], row[1], row[2]) for row in rows)

    def _store(self, values, texel, mix):
        if self.components == 1:
            return dr.scatter(values, self.dj.Array2f(*mix[0][1:]), texel)
        for k, part in enumerate(mix):
            dr.scatter(values, self.dj.Array4f(*part, 0), texel * self.components + k)

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
        width = channels(self.components)
        values = dr.zeros(self.dj.Float, width * texels * self.count)
        # A chunk of lights at a time bounds what a map source holds per ray.
        chunk = max(1, (1 << 22) // texels)
        for first in range(0, self.count, chunk):
            n = min(chunk, self.count - first)
            i = dr.arange(self.dj.UInt32, n * texels) + dr.opaque(self.dj.UInt32, first * texels)
            light = self._light(i // texels, True)
            rest, columns = i % texels, self.dj.UInt32(light[6])
            origin, d = self._ray(light, self.dj.Float(rest % columns), self.dj.Float(rest // columns))
            self._store(values, i, fit(origin, d))
            dr.eval(values)
        tensor = self.dj.TensorXf(values, (self.count * self.m, self.m, width))
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


CLEAR = -100.0
"""b of a ray that nothing blocks: S(1·(t + 100)) = 1 in float32 for every t of the sphere."""


def network_source(field, profile):
    """`map_source=network`: the mixture by one query of the ray network; τ = 1 where the ray meets nothing."""

    def fit(o, d):
        hit, _h, mix = field.ray_mixture(o, d, profile)
        share = 1 / len(mix)
        return tuple((dr.select(hit, w, share), dr.select(hit, a, 1), dr.select(hit, b, CLEAR)) for w, a, b in mix)

    return fit, field.components


LEVELS = (1e-3, math.log(4 / 3), math.log(2), math.log(4))
"""Optical depths where matter begins and where τ is 3/4, 1/2 and 1/4."""


def field_source(profile):
    """`map_source=field`: march the field once per ray, from the light inwards, and solve one logistic in closed
    form."""

    def fit(o, d):
        hit, _m, h = spheres.chord(ops, o, d)
        (first, *places), depth = profile(o, d, LEVELS)
        a, b = logistic.through_quantiles(ops, *places)
        a_part, b_part = _partial(h, first, depth)
        blocked, clear = depth >= LEVELS[-1], ~hit | (depth < LEVELS[0])
        a, b = dr.select(blocked, a, a_part), dr.select(blocked, b, b_part)
        return ((1.0, dr.select(clear, 1, a), dr.select(clear, CLEAR, b)),)

    return fit, 1


def _partial(h, begin, depth):
    """(a, b) of a ray that keeps p = e^−depth > 1/4 of the light: a logistic cannot rest at p, so it passes (1 + p)/2
    where the matter begins and p halfway from there to the far end."""
    p = dr.exp(-depth)
    top, low = dr.log((1 + p) / dr.maximum(1 - p, 1e-4)), dr.log(p / dr.maximum(1 - p, 1e-4))
    a = (top - low) / dr.maximum(0.5 * (begin + h), 1e-2)
    return a, begin - top / a
