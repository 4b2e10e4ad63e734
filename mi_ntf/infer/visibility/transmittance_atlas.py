"""``transmittance_atlas``: per field, transmittance maps of directions all around; any ray is read from one of them.

A ray from x along ω is read in two parts. Close to x, where a map of another direction would see the wrong piece of the
skin that x lies in, σ is summed at a few places, one drawn in each stratum of √t. The rest is one texel of one map: on
the line along its direction d_k that crosses the ray at the pivot x + c ω, from `BEGIN` on, all of it in smoke:

    τ(x, ω) ≈ exp(−Σ w_i σ(x + t_i ω)) · τ_k(x + c ω − (c − BEGIN) d_k)

Which of the four nearest directions and which of the four nearest texels is drawn with their bilinear weights: the mean
is the interpolated τ, and a pixel's many points average.
"""

from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from ...core import spheres
from ...core.ops import dot
from .. import octahedral, ops, profile
from ..lights import LightTable
from . import map_source, raymarch, two_logistics
from .method import Method, Options
from .transmittance_map import TransmittanceMap, channels

SIDE = 36
"""Directions: as many squared, octahedral. What their spacing blurs is most of the error: pictures of `globe` under an
environment err by 1.9 % with 28, 1.6 % with 36, 1.25 % with 56; of `statue` by 1.0 % with each."""
RESOLUTION = 51
"""Texels along a map's side: 51 MiB of two logistics each, in half precision."""
LOGISTICS = 2
RAYS = SIDE**2 * RESOLUTION**2
STRATA = 4
"""Places close to x: t = REACH v² with v = (i + u)/STRATA, all by the same u of a ray. Skins thin out away from x, and
strata of √t see each of their parts; the depth is right on average. Off by 1 % of τ at most where fixed places were by
2 to 4 % (RMS of the means; `statue`, `globe`, `knot`, `skull`), by three strata 2 %."""
BEGIN = 0.08
"""Where the map of an opaque thing is read from on: what lies between is neither's, or the skin of x would count
twice."""
REACH = 0.064
"""Where the sum ends. Smoke has no skin, and its map is read from x on: with the sum, pictures of `cloud` err by 1.7 %,
without by 1.0 %, with :data:`mi_ntf.infer.visibility.two_logistics.SMOKE` by 0.9 %."""
DARK = 3e-4
"""Where the map lets no more through than this, nobody looks how much of that the sum close to x would take."""
NEAREST_PIVOT, PIVOT = 0.16, 0.7
"""The pivot's least distance from x, and its share of the way to the middle of the chord: `globe` errs by 1.6 % with a
half of it, by 1.5 % with 0.7; `statue` by 1.0 % with both."""
OUTSIDE = 0.98
"""Squared distance from the origin where points lie in no skin: maps are read from the sphere on."""
COARSE = 7.0
"""Steps of the march that fills the maps of an opaque thing, in those of a transmittance map: what a texel blurs hides
more (pictures of `statue`, `globe` and `knot` err alike by 5 and 7)."""
SMOKE_STEP = 1 / 32
"""The same of smoke, field units: on `cloud` τ is off by 0.0273 (RMS), as by steps of 1/400."""


class TransmittanceAtlas:
    """`density`: σ at a point; `maps`: the :class:`TransmittanceMap` of the directions, read from the distance `begin`
    on, 0 in smoke; `march`: a :class:`mi_ntf.infer.visibility.raymarch.RayMarch` for what lies inside the sphere, which
    any drawn light may; `options`: of the maps. `stream`: a seed of the sampler, for the numbers that lookups draw,
    opaque, or each would be compiled."""

    def __init__(self, density, maps: TransmittanceMap, begin: float, march, options: Options, dj: ModuleType):
        self.density, self.maps, self.march, self.options, self.dj = density, maps, march, options, dj
        self._begin, self._skin = dr.opaque(dj.Float, begin), begin > 0
        self._side = dr.opaque(dj.Float, maps.count**0.5)
        self.stream = dr.opaque(dj.UInt32, 0)

    def tau(self, x, wi, distance, index, active):
        """The product of both parts; marched where the light lies inside the sphere, which kernels know nothing of
        where `distance` is literally infinite."""
        here = spheres.coordinate(x, wi)
        if distance.state == dr.VarState.Literal and dr.all(distance == dr.inf)[0]:
            return self._look_up(x, wi, here, active)
        _, _, h = spheres.chord(ops, x, wi)

        def march(x, wi, distance):
            return self.march.tau(x, wi, distance, index, self.dj.Bool(True))

        def look_up(x, wi, distance):
            return self._look_up(x, wi, here, True)

        return dr.if_stmt((x, wi, distance), active & (here + distance < h), march, look_up, label="light inside")

    def _look_up(self, x, wi, here, active):
        """0 where not `active`: often no light shines on any of the points that kernels look at together."""
        if active is True:
            return self._product(x, wi, here)

        def dark(x, wi, here):
            return type(here)(0)

        return dr.if_stmt((tuple(x), tuple(wi), here), active, self._product, dark, label="lit")

    def _product(self, x, wi, here):
        outside = dr.squared_norm(self.dj.Array3f(*x)) > OUTSIDE
        *u, v = _uniforms(self.dj, self.stream, x, wi)
        far = self._far(x, wi, here, outside, u)
        if not self._skin:
            return far

        def near(far, x, wi, v):
            return far * close_by(self.density, x, wi, v)

        def dark(far, x, wi, v):
            return far

        wanted = ~outside & (far > DARK)
        return dr.if_stmt((far, tuple(x), tuple(wi), v), wanted, near, dark, label="near")

    def _far(self, x, wi, here, outside, u):
        k, d = self._direction(wi, u[:2])
        pivot = dr.select(outside, dr.maximum(-here, 0), dr.maximum(-PIVOT * here, NEAREST_PIVOT))
        back = dr.select(outside, pivot, pivot - self._begin)
        y = tuple(a + pivot * b for a, b in zip(x, wi, strict=True))
        return self.maps.tau_of_one(k, y, dot(y, d) - back, u[2:])

    def _direction(self, wi, u):
        """``(index, direction)`` of one of the four nearest."""
        fu, fv = octahedral.place(wi, self._side)
        iu, iv = octahedral.wrap(dr.floor(fu + u[0]), dr.floor(fv + u[1]), self._side)
        return self.dj.UInt32(iv * self._side + iu), octahedral.direction(iu, iv, self._side)


def close_by(density, x, wi, v):
    """τ(x, ω) as far as `REACH`, drawn by the uniform number `v`: its optical depth is right on average."""
    depth = 0
    for i in range(STRATA):
        root = (v + i) * (1 / STRATA)
        t = REACH * root * root
        depth += root * density(tuple(a + t * b for a, b in zip(x, wi, strict=True)))
    return dr.exp((-2 * REACH / STRATA) * depth)


def _uniforms(dj, stream, x, wi) -> list:
    """Five numbers in [0, 1) of the seed `stream` and the bits of a ray: the same of both, the same numbers."""
    state = dj.UInt32(stream)
    for c, factor in zip((*x, *wi), (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1, 0xD3A2646D),
                         strict=True):
        word: Any = dr.reinterpret_array(dj.UInt32, c)
        state = (state ^ (word * factor)) * 0x2C1B3C6D
        state ^= state >> 15
    words = [state]
    for key, factor in ((0x5BD1E995, 0x297A2D39), (0x68E31DA4, 0xB5297A4D)):
        word = (words[-1] ^ key) * factor
        words.append(word ^ (word >> 15))
    halves = [half for word in words for half in (word & 0xFFFF, word >> 16)]
    return [dj.Float(half) * 2.0**-16 for half in halves[:5]]


def table(dj: ModuleType) -> LightTable:
    """The directions as lights."""
    v, u = np.divmod(np.arange(SIDE**2), SIDE)
    d = np.stack(octahedral.direction(dj.Float(u.astype(np.float32)), dj.Float(v.astype(np.float32)), dj.Float(SIDE)))
    where = np.array(d, np.float64).T
    return LightTable(where, np.ones((SIDE**2, 3)), np.zeros(SIDE**2, bool), 1.0, dj)


def build(medium, lights, options: Options, dj, keep) -> TransmittanceAtlas:
    """See :class:`mi_ntf.infer.visibility.method.Method`."""
    network = options.map_source == "network"
    step = options.step * COARSE * (profile.FOR_NETWORKS if network else profile.FOR_MAPS)
    begin, effort = BEGIN, two_logistics.ROUGH
    if not medium.field.softness.opaque:
        step, begin, effort = max(step, SMOKE_STEP), 0.0, two_logistics.SMOKE
    reader = profile.of(medium, step, dj)
    source = (map_source.network_source(medium.field.network, reader, False) if network
              else map_source.field_source(medium.source, reader, LOGISTICS, effort))
    directions = table(dj)
    own = replace(options, map_resolution=RESOLUTION, map_components=LOGISTICS, half=True)

    def make(values=None):
        return TransmittanceMap(directions, own.map_resolution, medium.field.grid.hull, source, dj, values, own.half)

    maps = keep(make, channels=channels(source.components, source.weights), step=step, directions=directions,
                options=own)
    march = raymarch.build(medium, lights, options, dj, keep)
    # Voxels will do, also for a field that is its networks.
    return TransmittanceAtlas(medium.field.grid.density, maps, begin, march, own, dj)


def numbers(medium, lights, options: Options) -> int:
    """Return the size of all maps, in float32 numbers."""
    network = options.map_source == "network"
    return RAYS * channels(medium.field.network.components if network else LOGISTICS) // 2


METHOD = Method(
    name="transmittance_atlas",
    summary="per field, maps of directions all around: one texel and a few densities per point and light",
    build=build,
    rays=lambda lights, resolution: RAYS,
    numbers=numbers,
    per_field=True,
    dials=("map_source", "map_file"),
    automatic=True,
)
