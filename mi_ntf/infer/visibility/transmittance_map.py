"""The transmittance map: per light, a 2-D table of the logistic's (a, b) (method.md, section 6; Shafiei et al. 2021,
section 3.3, with the slips of its algorithms corrected).

Parametrisation per light, both covering the ball around all density (`radius` ≤ 1) and nothing more:

    directional   parallel rays through an m × m grid on the disc through the origin perpendicular to the light
    point         rays of a pinhole at the light, m × m over the square that circumscribes the ball's silhouette

A texel holds (a, b) of the ray through its centre, towards the light. A lookup evaluates the four nearest rays, each at
the plane through the point that is perpendicular to the direction to the light, and interpolates the four τ bilinearly.
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


class TransmittanceMap:
    """Maps of all lights of a table, m × m texels each, in one Dr.Jit texture of (a, b), layer upon layer.

    `fit(o, d) → (a, b)` solves the logistic of rays through `o` towards the light along `d`. `radius`: of the ball
    around all density. Memory: 8 m² bytes a light.
    """

    def __init__(self, lights: LightTable, resolution: int, radius: float, fit, dj: ModuleType):
        self.dj, self.m, self.count = dj, resolution, lights.count
        self.radius = max(radius, 1e-3)
        axis, u, v, position, spread = _frames(lights, self.radius)
        # One row of 14 floats a light: frame (axis points away from the light), position, half width, point flag.
        rows = np.concatenate([axis, u, v, position, spread[:, None], lights.is_point[:, None]], axis=1)
        self._rows = dj.Float(rows.astype(np.float32).ravel())
        self.texture = self._build(fit)

    def tau(self, x, wi, distance, index, active):
        """Bilinear τ of the four nearest texel rays; 1 outside the map."""
        light = self._light(index, active)
        axis, u, v, position, spread, point = light
        rel = tuple(a - point * b for a, b in zip(x, position, strict=True))
        depth = dr.select(point > 0, dot(rel, axis), 1)
        scale = dr.rcp(dr.maximum(depth, 1e-6) * spread)
        fu = (dot(rel, u) * scale * 0.5 + 0.5) * self.m - 0.5
        fv = (dot(rel, v) * scale * 0.5 + 0.5) * self.m - 0.5
        inside = active & (fu > -0.5) & (fv > -0.5) & (fu < self.m - 0.5) & (fv < self.m - 0.5)
        iu, iv = dr.floor(fu), dr.floor(fv)
        wu, wv = fu - iu, fv - iv
        result = 0
        for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
            tu, tv = (dr.clip(c, 0, self.m - 1) for c in (iu + du, iv + dv))
            a, b = self._fetch(index, tu, tv, inside)
            t = self._coordinate(light, x, wi, distance, tu, tv)
            weight = (wu if du else 1 - wu) * (wv if dv else 1 - wv)
            result += weight * logistic.transmittance(ops, t, a, b)
        return dr.select(inside, result, 1)

    def _fetch(self, index, tu, tv, active):
        uint = self.dj.UInt32
        texel = (uint(index) * self.m + uint(tv)) * self.m + uint(tu)
        pair = dr.gather(self.dj.Array2f, self.texture.tensor().array, texel, active)
        return pair[0], pair[1]

    def _light(self, index, active):
        base = self.dj.UInt32(index) * 14
        row = [dr.gather(self.dj.Float, self._rows, base + i, active) for i in range(14)]
        return tuple(row[0:3]), tuple(row[3:6]), tuple(row[6:9]), tuple(row[9:12]), row[12], row[13]

    def _ray(self, light, tu, tv):
        """Point and direction (towards the light) of the ray through texel (tu, tv)'s centre."""
        axis, u, v, position, spread, point = light
        su, sv = (((c + 0.5) * (2 / self.m) - 1) * spread for c in (tu, tv))
        offset = tuple(su * a + sv * b for a, b in zip(u, v, strict=True))
        out = tuple(a + point * c for a, c in zip(axis, offset, strict=True))
        norm = dr.rsqrt(dot(out, out))
        origin = tuple(dr.select(point > 0, p, c) for p, c in zip(position, offset, strict=True))
        return origin, tuple(-c * norm for c in out)

    def _coordinate(self, light, x, wi, distance, tu, tv):
        """t' on the texel's ray where the plane through x perpendicular to ω_i cuts it.

        Directional: all rays are parallel, t' = ⟨x, ω'⟩ on every one. Point light at L: the ray leaves L along −ω', so
        the plane lies s = |x − L|/⟨ω', ω_i⟩ away and t' = ⟨L, ω'⟩ − s.
        """
        point = light[5] > 0
        _, d = self._ray(light, tu, tv)
        s = distance / dr.maximum(dot(d, wi), 1e-3)
        return dr.select(point, dot(light[3], d) - dr.select(point, s, 0), dot(x, d))

    def _build(self, fit):
        texels = self.m * self.m
        values = dr.zeros(self.dj.Float, 2 * texels * self.count)
        # A chunk of lights at a time bounds what a map source holds per ray.
        chunk = max(1, (1 << 22) // texels)
        for first in range(0, self.count, chunk):
            n = min(chunk, self.count - first)
            i = dr.arange(self.dj.UInt32, n * texels) + dr.opaque(self.dj.UInt32, first * texels)
            light = self._light(i // texels, True)
            rest = i % texels
            origin, d = self._ray(light, self.dj.Float(rest % self.m), self.dj.Float(rest // self.m))
            a, b = fit(origin, d)
            dr.scatter(values, self.dj.Array2f(a, b), i)
            dr.eval(values)
        tensor = self.dj.TensorXf(values, (self.count * self.m, self.m, 2))
        return self.dj.Texture2f(tensor, use_accel=False, filter_mode=dr.FilterMode.Nearest)


def _frames(lights: LightTable, radius: float):
    """Per light: unit axis away from the light, two perpendicular unit vectors, position (0 if directional), half
    width."""
    distance = np.linalg.norm(lights.where, axis=1)
    near = lights.is_point & (distance <= radius * 1.001)
    if near.any():
        raise MiNtfError(
            f"transmittance_map: point light {int(np.argmax(near))} lies inside the captured object's bounding "
            f"sphere ({distance[near][0]:.3g} of {radius:.3g} field units from its centre), where a frustum map "
            "cannot cover it; move the light out or use visibility=raymarch or neural_transmittance"
        )
    axis = -lights.where / distance[:, None]
    helper = np.where(np.abs(axis[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    sine = np.minimum(radius / distance, 0.9995)
    spread = np.where(lights.is_point, sine / np.sqrt(1 - sine**2), radius)
    return axis, u, v, np.where(lights.is_point[:, None], lights.where, 0.0), spread


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
