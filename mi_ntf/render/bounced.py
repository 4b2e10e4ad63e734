"""Further bounces of light within fields, without noise: radiosity between patches of their skins."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import microfacet, radiosity
from ..infer import march, shade
from ..infer.irradiance import Irradiance

CHORDS = 1 << 16
"""Random lines through a field's sphere that look for its skin; rays from what they find look into its folds."""
STEPS = 384
"""Steps of those lines across the sphere."""
SIDE = 16
"""Rays from a patch, squared: where a tenth of them meets something, the bounced light is right within a fifth, and
pictures show the mean of some patches."""
SEED = 7


class Bounced:
    """Light that fields of `composition` (:class:`mi_ntf.render.composition.Composition`) scatter more than once, their
    skins taken for diffuse surfaces that reflect as much as both lobes. `max_depth`: longest path in edges, −1
    for any."""

    def __init__(self, composition, max_depth: int):
        self._composition = composition
        rng = np.random.default_rng(SEED)
        self._skins = [_Skin(part, _chords(part, rng)) for part in composition.parts]
        for skin, found in zip(self._skins, self._look(4, rng), strict=True):
            skin.add(*found)
        first = np.cumsum([0, *(len(s.position) for s in self._skins)])
        hits = self._hits(first, rng)
        albedo = np.concatenate([s.albedo for s in self._skins])
        direct = np.concatenate([self._direct(s) for s in self._skins])
        light = radiosity.solve(hits, albedo, direct, max(max_depth - 2, -1))
        self._irradiance = [Irradiance(s.table, light[a:b], mi)
                            for s, a, b in zip(self._skins, first, first[1:], strict=False)]

    def reflect(self, part, points) -> list:
        """Radiance that `points` of `part` send on of it."""
        index = next(i for i, p in enumerate(self._composition.parts) if p.medium is part.medium)
        light = self._irradiance[index](points.x, points.normal)
        _, albedo, roughness, specular, _ = points.reflectance
        return [microfacet.diffuse_albedo(k, roughness, specular) * e * microfacet.INV_PI
                for k, e in zip(albedo, light, strict=True)]

    def _look(self, side: int, rng) -> list:
        """For each skin, points and directions of the rays that meet it, `side`² from each patch."""
        return [(x, d) for x, d, _ in self._trace(side, rng)]

    def _hits(self, first, rng) -> np.ndarray:
        """(patches, rays): what each ray meets, −1 for nothing or matter seen from behind."""
        count = SIDE**2
        hits = np.full(first[-1] * count, -1)
        for skin, start, (x, d, ray) in zip(self._skins, first, self._trace(SIDE, rng), strict=False):
            normal = skin.reflectance(x)[0]
            patch = skin.table[radiosity.place(x, normal)]
            hits[ray] = np.where(((normal * d).sum(1) < 0) & (patch >= 0), patch + start, -1)
        return hits.reshape(-1, count)

    def _trace(self, side: int, rng) -> list:
        """Rays from all patches: for each skin the points (k, 3) where it is met, the rays' directions (k, 3), both in
        its own coordinates, and their indices (k,)."""
        origins, ways = [], []
        for skin in self._skins:
            frame = skin.part.frame
            d = radiosity.directions(skin.normal, side, rng)
            o = np.broadcast_to(skin.outside[:, None], d.shape)
            origins.append(np.array(frame.point_to_world(_vector(o))))
            ways.append(np.array(frame.direction_to_world(_vector(d))))
        o, d = (mi.Vector3f(np.concatenate(v, 1)) for v in (origins, ways))
        n = dr.width(o)
        hit, t, which = self._composition.fly(mi.Ray3f(mi.Point3f(o), d), dr.full(mi.Float, dr.inf, n),
                                              mi.Float(rng.random(n)), mi.Float(radiosity.DEPTH), mi.Float(0.5))
        hit, which = hit.numpy(), which.numpy()
        result = []
        for i, skin in enumerate(self._skins):
            index = np.flatnonzero(hit & (which == i))
            k = mi.UInt32(index)
            along = dr.gather(mi.Vector3f, d, k)
            x = dr.gather(mi.Vector3f, o, k) + dr.gather(mi.Float, t, k) * along
            result.append((_rows(skin.part.frame.point_to_field(mi.Point3f(x))),
                           _rows(skin.part.frame.direction_to_field(along)), index))
        return result

    def _direct(self, skin: "_Skin") -> np.ndarray:
        """(patches, 3): irradiance by the lights alone."""
        n = len(skin.position)
        one, zero = dr.ones(mi.Float, n), dr.zeros(mi.Float, n)
        normal = tuple(_vector(skin.normal))
        white = shade.Points(tuple(_vector(skin.outside)), normal, (normal, (one, one, one), one, zero, zero))
        light = self._composition.reflect(skin.part, white, dr.opaque(mi.UInt32, SEED), surface=True)
        return np.stack([c.numpy() for c in light], 1).astype(np.float64) * np.pi


class _Skin:
    """The patches of one `part`: `position`, `normal`, `albedo` (n, 3); `outside`, points above them; `table`."""

    def __init__(self, part, found):
        self.part = part
        self.position = np.zeros((0, 3))
        self.add(*found)

    def add(self, x: np.ndarray, d: np.ndarray) -> None:
        """Points that rays along `d` meet become patches where there are none."""
        normal, _ = self.reflectance(x)
        x = np.concatenate([self.position, x[(normal * d).sum(1) < 0]])
        normal, albedo = self.reflectance(x)
        kept = radiosity.thin(x, normal)
        self.position, self.normal, self.albedo = x[kept], normal[kept], albedo[kept]
        self.outside = self.position + radiosity.RISE * self.normal
        self.table = radiosity.table(self.position, self.normal)

    def reflectance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals and albedos (n, 3) at field points."""
        normal, albedo, roughness, specular, _ = self.part.medium.reflectance(tuple(_vector(x)))
        return _rows(normal), _rows([microfacet.diffuse_albedo(k, roughness, specular) for k in albedo])


def _chords(part, rng) -> tuple[np.ndarray, np.ndarray]:
    """Points where random lines through the sphere of `part` meet its skin first, and the lines' directions."""
    o = rng.normal(size=(CHORDS, 3))
    o /= np.linalg.norm(o, axis=1, keepdims=True)
    d = -radiosity.directions(o, 1, rng)[:, 0]
    start = _vector(o - 0.1 * d)
    strand = march.Strand(part.source.density, part.medium.field.grid, tuple(start), tuple(_vector(d)),
                          dr.opaque(mi.Float, 2 / STEPS))
    hit, t, _, bundle = march.free_flight([strand], dr.full(mi.Float, dr.inf, CHORDS), mi.Float(rng.random(CHORDS)),
                                          mi.Float(radiosity.DEPTH), mi.Float(0.5))
    x = start + (bundle.base + t) * _vector(d)
    met = hit.numpy()
    return _rows(x)[met], d[met]


def _vector(rows: np.ndarray):
    return mi.Vector3f(np.ascontiguousarray(rows.reshape(-1, 3).T, np.float32))


def _rows(v) -> np.ndarray:
    return np.stack([c.numpy() for c in v], 1).astype(np.float64)
