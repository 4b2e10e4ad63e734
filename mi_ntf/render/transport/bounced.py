"""Multiple scattering between fields without noise: radiosity between patches of their skins."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import microfacet, radiosity
from ...infer import march, shade
from ...infer.backend import floats, module_of, words
from ...infer.bundle import Strand
from ...infer.irradiance import Irradiance
from ...infer.types import Float, Vector, Vector3
from .. import log, user_cache
from ..maps import building
from ..scene.media import NRFMedium
from .shadow import Part

if TYPE_CHECKING:
    from .composition import Composition

SEED = 7
LIGHT_SAMPLES = 64
"""Least number of sampled lights of a patch. They are the same for all samples of a pixel."""


class _Hits(NamedTuple):
    """Points of a skin that rays hit, (k, 3), the rays' directions, (k, 3), and the rays' indices, (k,)."""

    x: np.ndarray
    d: np.ndarray
    ray: np.ndarray


class Patches:
    """Patches of the skins of all fields of a scene, and the visibility between them. Lights play no part.

    first   number of each skin's first patch
    hits    (patches, rays): the patch that each ray from a patch hits, −1 for none
    albedo  (patches, 3)

    The patches are stored in the user's cache.
    """

    def __init__(self, scene: Composition) -> None:
        self._key = _key(scene)
        self.skins = [Skin(part.medium) for part in scene.parts]
        # Values that were set in the scene have a name in this process alone.
        changed = any(part.medium.field.appearance != part.medium.field.digest for part in scene.parts)
        arrays = self._search(scene) if changed else user_cache.cached(
            "patches", user_cache.key(*self._key), lambda: self._search(scene), placed=len(self.skins) > 1)
        for number, skin in enumerate(self.skins):
            for name in Skin.ARRAYS:
                setattr(skin, name, arrays[f"{number}.{name}"])
        self.first, self.hits = arrays["first"], arrays["hits"]
        self.albedo = np.concatenate([s.albedo for s in self.skins])
        log.info(f"nrf integrator: light bounces between {len(self.albedo)} patches of skins, which count as diffuse: "
                 "fast and biased; bounces=paths is not")

    def _search(self, scene: Composition) -> dict[str, np.ndarray]:
        with log.Work("nrf integrator", "finding the patches that light bounces between"):
            return self._arrays(scene)

    def _arrays(self, scene: Composition) -> dict[str, np.ndarray]:
        """Return the arrays of all skins, `first` and `hits`, computed by random rays."""
        rng = np.random.default_rng(SEED)
        self.skins[:] = [skin_of(part.medium, rng) for part in scene.parts]
        for skin, hits_of_skin in zip(self.skins, self._trace(scene, radiosity.FEW, rng), strict=True):
            skin.add(hits_of_skin.x, hits_of_skin.d)
        first = np.cumsum([0, *(len(s.position) for s in self.skins)])
        hits = np.full(first[-1] * radiosity.SIDE**2, -1, np.int32)
        for skin, start, (x, d, ray) in zip(self.skins, first, self._trace(scene, radiosity.SIDE, rng), strict=False):
            normal, _ = skin.reflectance(x)
            patch = skin.table[radiosity.place(x, normal)]
            # Matter that is seen from behind sends no light.
            hits[ray] = np.where(((normal * d).sum(1) < 0) & (patch >= 0), patch + start, -1)
        arrays = {f"{i}.{name}": getattr(s, name) for i, s in enumerate(self.skins) for name in Skin.ARRAYS}
        return arrays | {"first": first, "hits": hits.reshape(-1, radiosity.SIDE**2)}

    def fit(self, scene: Composition) -> bool:
        """Return True if `scene` has the same fields in the same places."""
        return self._key == _key(scene)

    def _trace(self, scene: Composition, side: int, rng: np.random.Generator) -> list[_Hits]:
        """Trace `side`² rays from each patch; return their hits on each skin, in its own coordinates."""
        origins, directions = [], []
        for skin in self.skins:
            origin, direction = radiosity.rays(skin.position, skin.normal, side, rng)
            origins.append(np.array(skin.frame.point_to_world(_vector(origin))))
            directions.append(np.array(skin.frame.direction_to_world(_vector(direction))))
        o, d = (_vector(np.concatenate(v, 1).T) for v in (origins, directions))
        n, nothing = dr.width(o), _Hits(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, int))
        if not n:
            return [nothing] * len(self.skins)
        hit, t, part = scene.free_flight(mi.Ray3f(mi.Point3f(o), d), dr.full(mi.Float, dr.inf, n),
                                         floats(rng.random(n), mi), [mi.Float(radiosity.DEPTH)] * len(self.skins),
                                         radiosity.STEPS)
        dr.eval(hit, t, part)
        parts = np.where(hit.numpy(), part.numpy().astype(np.int64), -1)
        result = []
        for i, skin in enumerate(self.skins):
            index = np.flatnonzero(parts == i)
            if not len(index):
                result.append(nothing)
                continue
            k = words(index, mi)
            along: Vector3 = dr.gather(mi.Vector3f, d, k)
            x = dr.gather(mi.Vector3f, o, k) + dr.gather(mi.Float, t, k) * along
            x, along = skin.frame.point_to_field(mi.Point3f(x)), skin.frame.direction_to_field(along)
            dr.eval(x, along)
            result.append(_Hits(_rows(x), _rows(along), index))
        return result


def _key(scene: Composition) -> tuple[object, ...]:
    """Return all inputs of patches. The patches of a single field do not depend on its placement."""
    media = [part.medium for part in scene.parts]
    fields = [(m.field.appearance, m.representation, m.field.grid.resolution, len(media) > 1 and m.frame.placement())
              for m in media]
    return mi.variant(), min(radiosity.STEPS, scene.settings.samples or radiosity.STEPS), tuple(fields)


class Bounced:
    """Light that the fields of `scene` scatter more than once, between their `patches`.

    Skins count as diffuse surfaces that reflect as much as both lobes. `max_depth`: longest path in edges, −1 for any.
    """

    def __init__(self, scene: Composition, patches: Patches, max_depth: int) -> None:
        self._media = [part.medium for part in scene.parts]
        pairs = zip(scene.parts, patches.skins, strict=True)
        direct = np.concatenate([_direct(scene, part, skin) for part, skin in pairs])
        light = radiosity.solve(patches.hits, patches.albedo, direct, max(max_depth - 2, -1))
        ends = zip(patches.first, patches.first[1:], strict=False)
        self._irradiance = [Irradiance(s.table, light[a:b], module_of(mi.Float))
                            for s, (a, b) in zip(patches.skins, ends, strict=True)]

    def reflect(self, part: Part, points: shade.Points) -> list[Float]:
        """Return the radiance of multiple scattering that points of `part` reflect."""
        index = next(i for i, m in enumerate(self._media) if m is part.medium)
        light = self._irradiance[index](points.x, points.normal)
        albedo = points.reflectance.diffuse_albedo()
        return [k * e * microfacet.INV_PI for k, e in zip(albedo, light, strict=True)]


def _direct(scene: Composition, part: Part, skin: Skin) -> np.ndarray:
    """Return the irradiance (patches, 3) of the `skin` of `part` by the lights alone."""
    n = len(skin.position)
    if not n:
        return np.zeros((0, 3))
    one, zero = dr.ones(mi.Float, n), dr.zeros(mi.Float, n)
    x, normal = radiosity.above(skin.position, skin.normal), tuple(_vector(skin.normal))
    reflectance = shade.Reflectance(normal, (one, one, one), one, (zero, zero, zero), zero)
    white = shade.Points(tuple(_vector(x)), normal, reflectance)
    light = scene.reflect(part, white, dr.opaque(mi.UInt32, SEED), surface=True, light_samples=LIGHT_SAMPLES)
    return _rows(light) * np.pi


class Skin:
    """Patches of one `medium`, none before :meth:`add`.

    position, normal, albedo  (n, 3)
    table                     cells → patches (:func:`mi_ntf.core.radiosity.table`)
    """

    ARRAYS = "position", "normal", "albedo", "table"
    normal: np.ndarray
    albedo: np.ndarray
    table: np.ndarray

    def __init__(self, medium: NRFMedium) -> None:
        self.frame, self._reflectance = medium.frame, medium.reflectance
        self.position = np.zeros((0, 3))

    def add(self, x: np.ndarray, d: np.ndarray) -> None:
        """Add patches at the points `x` (n, 3) where there are none yet; `d`: directions of rays that hit them."""
        normal, _ = self.reflectance(x)
        x = np.concatenate([self.position, x[(normal * d).sum(1) < 0]])
        normal, albedo = self.reflectance(x)
        index = radiosity.thin(x, normal)
        self.position, self.normal, self.albedo = x[index], normal[index], albedo[index]
        self.table = radiosity.table(self.position, self.normal)

    def reflectance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return normals and diffuse albedos (n, 3) at field points."""
        if not len(x):
            return np.zeros((0, 3)), np.zeros((0, 3))
        reflectance = self._reflectance(tuple(_vector(x)))
        albedo = reflectance.diffuse_albedo()
        dr.eval(reflectance.normal, albedo)
        return _rows(reflectance.normal), _rows(albedo)


def skin_of(medium: NRFMedium, rng: np.random.Generator) -> Skin:
    """Return the patches that random lines through the sphere of `medium` hit."""
    skin = Skin(medium)
    skin.add(*_chords(medium, rng))
    return skin


def _chords(medium: NRFMedium, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return first hits of random lines through the sphere of `medium` on its skin, and the lines' directions."""
    o = rng.normal(size=(radiosity.CHORDS, 3))
    o /= np.linalg.norm(o, axis=1, keepdims=True)
    d = -radiosity.directions(o, 1, rng)[:, 0]
    hit, x = first_hits(medium, o - 0.1 * d, d, rng)
    return x[hit], d[hit]


def first_hits(medium: NRFMedium, o: np.ndarray, d: np.ndarray, rng: np.random.Generator
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of the rays (n, 3), field coordinates, that hit the skin of `medium`, and their first hits."""
    n, start, along = len(o), _vector(o), _vector(d)
    steps = radiosity.STEPS * building.samples(medium) // building.SAMPLES
    strand = Strand(medium.source, tuple(start), tuple(along), dr.opaque(mi.Float, 2 / steps))
    hit, t, _ = march.free_flight([strand], dr.full(mi.Float, dr.inf, n), floats(rng.random(n), mi),
                                  [mi.Float(radiosity.DEPTH)])
    x = start + dr.select(hit, t, 0) * along
    dr.eval(x, hit)
    return hit.numpy(), _rows(x)


def _vector(rows: np.ndarray) -> Vector3:
    # Built from components, since the shape of a two-dimensional array would be part of kernels.
    return mi.Vector3f(*(floats(column, mi) for column in rows.reshape(-1, 3).T))


def _rows(v: Vector | Vector3) -> np.ndarray:
    dr.eval(v)  # together, in one kernel
    return np.stack([c.numpy() for c in v], 1).astype(np.float64)
