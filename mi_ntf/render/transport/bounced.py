"""Further bounces of light within fields, without noise: radiosity between patches of their skins."""

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import microfacet, radiosity
from ...infer import march, shade
from ...infer.backend import floats, words
from ...infer.bundle import Strand
from ...infer.irradiance import Irradiance
from .. import log, user_cache

SEED = 7
DRAWS = 16
"""Lights of a patch, where lights are drawn: at least. They are the same for all samples of a pixel, however many."""


class Patches:
    """The skins of all fields of a scene and what their patches see of each other, whatever the lights.

    `composition`: a :class:`mi_ntf.render.transport.composition.Composition`. `first`: number of each skin's first
    patch; `hits` (patches, rays): the patch that each ray meets, −1 for none. They are found in the user's cache.
    """

    def __init__(self, composition):
        self._key = _key(composition)
        self.skins = [Skin(part.medium) for part in composition.parts]
        found = user_cache.kept("patches", user_cache.key(*self._key), lambda: self._found(composition),
                                placed=len(self.skins) > 1)
        for number, skin in enumerate(self.skins):
            for name in Skin.ARRAYS:
                setattr(skin, name, found[f"{number}.{name}"])
        self.first, self.hits = found["first"], found["hits"]
        self.albedo = np.concatenate([s.albedo for s in self.skins])
        log.info(f"nrf integrator: light bounces between {len(self.albedo)} patches of skins, which count as diffuse: "
                 "fast and biased; bounces=paths is not")

    def _found(self, composition) -> dict[str, np.ndarray]:
        """Return the arrays of all skins, found by random rays, and `first` and `hits`."""
        begin = time.perf_counter()
        rng = np.random.default_rng(SEED)
        self.skins[:] = [skin_of(part.medium, rng) for part in composition.parts]
        for skin, (x, d, _) in zip(self.skins, self._trace(composition, radiosity.FEW, rng), strict=True):
            skin.add(x, d)
        first = np.cumsum([0, *(len(s.position) for s in self.skins)])
        hits = np.full(first[-1] * radiosity.SIDE**2, -1, np.int32)
        met_of_skins = self._trace(composition, radiosity.SIDE, rng)
        for skin, start, met in zip(self.skins, first, met_of_skins, strict=False):
            x, d, ray = met
            normal, _ = skin.reflectance(x)
            patch = skin.table[radiosity.place(x, normal)]
            # Nothing comes from matter that is seen from behind.
            hits[ray] = np.where(((normal * d).sum(1) < 0) & (patch >= 0), patch + start, -1)
        arrays = {f"{i}.{name}": getattr(s, name) for i, s in enumerate(self.skins) for name in Skin.ARRAYS}
        log.info(f"nrf integrator: found the patches that light bounces between ({time.perf_counter() - begin:.2g} s)")
        return arrays | {"first": first, "hits": hits.reshape(-1, radiosity.SIDE**2)}

    def of(self, composition) -> bool:
        """Return True if these are the patches of `composition`, too: of the same fields in the same places."""
        return self._key == _key(composition)

    def _trace(self, composition, side: int, rng) -> list:
        """`side`² rays from each patch: for each skin the points (k, 3) where it is met, the rays' directions (k, 3),
        both in its own coordinates, and their indices (k,)."""
        origins, ways = [], []
        for skin in self.skins:
            begin, way = radiosity.rays(skin.position, skin.normal, side, rng)
            origins.append(np.array(skin.frame.point_to_world(_vector(begin))))
            ways.append(np.array(skin.frame.direction_to_world(_vector(way))))
        o, d = (_vector(np.concatenate(v, 1).T) for v in (origins, ways))
        n, nothing = dr.width(o), (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, int))
        if not n:
            return [nothing] * len(self.skins)
        steps = min(radiosity.STEPS, composition.settings.samples)
        hit, t, which = composition.fly(mi.Ray3f(mi.Point3f(o), d), dr.full(mi.Float, dr.inf, n),
                                        floats(rng.random(n), mi), [mi.Float(radiosity.DEPTH)] * len(self.skins), steps)
        dr.eval(hit, t, which)
        hit, which = hit.numpy(), which.numpy()
        result = []
        for i, skin in enumerate(self.skins):
            index = np.flatnonzero(hit & (which == i))
            if not len(index):
                result.append(nothing)
                continue
            k = words(index, mi)
            along: Any = dr.gather(mi.Vector3f, d, k)
            x = dr.gather(mi.Vector3f, o, k) + dr.gather(mi.Float, t, k) * along
            place, way = skin.frame.point_to_field(mi.Point3f(x)), skin.frame.direction_to_field(along)
            dr.eval(place, way)
            result.append((_rows(place), _rows(way), index))
        return result


def _key(composition) -> tuple:
    """Return what patches depend on: those of a single field do not on its place."""
    media = [part.medium for part in composition.parts]
    fields = [(m.field.digest, m.representation, m.field.grid.resolution, len(media) > 1 and m.frame.placement())
              for m in media]
    return mi.variant(), min(radiosity.STEPS, composition.settings.samples), tuple(fields)


class Bounced:
    """Light that fields of `composition` scatter more than once, between their `patches`: skins taken for diffuse
    surfaces that reflect as much as both lobes. `max_depth`: longest path in edges, −1 for any."""

    def __init__(self, composition, patches: Patches, max_depth: int):
        self._media = [part.medium for part in composition.parts]
        pairs = zip(composition.parts, patches.skins, strict=True)
        direct = np.concatenate([_direct(composition, part, skin) for part, skin in pairs])
        light = radiosity.solve(patches.hits, patches.albedo, direct, max(max_depth - 2, -1))
        ends = zip(patches.first, patches.first[1:], strict=False)
        self._irradiance = [Irradiance(s.table, light[a:b], mi) for s, (a, b) in zip(patches.skins, ends, strict=True)]

    def reflect(self, part, points) -> list:
        """Radiance that `points` of `part` send on of it."""
        index = next(i for i, m in enumerate(self._media) if m is part.medium)
        light = self._irradiance[index](points.x, points.normal)
        albedo = points.reflectance.diffuse_albedo()
        return [k * e * microfacet.INV_PI for k, e in zip(albedo, light, strict=True)]


def _direct(composition, part, skin: "Skin") -> np.ndarray:
    """(patches, 3): irradiance of the `skin` of `part` by the lights alone."""
    n = len(skin.position)
    if not n:
        return np.zeros((0, 3))
    one, zero = dr.ones(mi.Float, n), dr.zeros(mi.Float, n)
    x, normal = radiosity.above(skin.position, skin.normal), tuple(_vector(skin.normal))
    white = shade.Points(tuple(_vector(x)), normal, shade.Reflectance(normal, (one, one, one), one, zero, zero))
    light = composition.reflect(part, white, dr.opaque(mi.UInt32, SEED), surface=True, draws=DRAWS)
    return _rows(light) * np.pi


class Skin:
    """The patches of one `medium`: `position`, `normal`, `albedo` (n, 3); `table`; none before :meth:`add`."""

    ARRAYS = "position", "normal", "albedo", "table"

    def __init__(self, medium):
        self.frame, self._reflectance = medium.frame, medium.reflectance
        self.position = np.zeros((0, 3))

    def add(self, x: np.ndarray, d: np.ndarray) -> None:
        """Points that rays along `d` meet become patches where there are none."""
        normal, _ = self.reflectance(x)
        x = np.concatenate([self.position, x[(normal * d).sum(1) < 0]])
        normal, albedo = self.reflectance(x)
        kept = radiosity.thin(x, normal)
        self.position, self.normal, self.albedo = x[kept], normal[kept], albedo[kept]
        self.table = radiosity.table(self.position, self.normal)

    def reflectance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals and diffuse albedos (n, 3) at field points."""
        if not len(x):
            return np.zeros((0, 3)), np.zeros((0, 3))
        found = self._reflectance(tuple(_vector(x)))
        albedo = found.diffuse_albedo()
        dr.eval(found.normal, albedo)
        return _rows(found.normal), _rows(albedo)


def skin_of(medium, rng) -> Skin:
    """Return the patches that random lines through the sphere of `medium` meet."""
    skin = Skin(medium)
    skin.add(*_chords(medium, rng))
    return skin


def _chords(medium, rng) -> tuple[np.ndarray, np.ndarray]:
    """Points where random lines through the sphere of `medium` meet its skin first, and the lines' directions."""
    o = rng.normal(size=(radiosity.CHORDS, 3))
    o /= np.linalg.norm(o, axis=1, keepdims=True)
    d = -radiosity.directions(o, 1, rng)[:, 0]
    met, x = meet(medium.source, o - 0.1 * d, d, rng)
    return x[met], d[met]


def meet(volume, o: np.ndarray, d: np.ndarray, rng) -> tuple[np.ndarray, np.ndarray]:
    """Return for rays (n, 3), field coordinates, if they meet the skin of a :class:`mi_ntf.infer.grid.Volume`, and
    where first."""
    n, start, along = len(o), _vector(o), _vector(d)
    strand = Strand(volume, tuple(start), tuple(along), dr.opaque(mi.Float, 2 / radiosity.STEPS))
    hit, t, _ = march.free_flight([strand], dr.full(mi.Float, dr.inf, n), floats(rng.random(n), mi),
                                  [mi.Float(radiosity.DEPTH)])
    x = start + dr.select(hit, t, 0) * along
    dr.eval(x, hit)
    return hit.numpy(), _rows(x)


def _vector(rows: np.ndarray):
    # By components: the length of an array of two dimensions would be part of kernels.
    return mi.Vector3f(*(floats(column, mi) for column in rows.reshape(-1, 3).T))


def _rows(v) -> np.ndarray:
    dr.eval(v)  # together, or each would be computed by itself
    return np.stack([c.numpy() for c in v], 1).astype(np.float64)
