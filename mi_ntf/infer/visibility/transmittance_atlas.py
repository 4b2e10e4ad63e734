"""``transmittance_atlas``: per field, transmittance maps of directions all around; any ray is read from one of them.

A ray from x along ω is read in two parts. Close to x, where a map of another direction would see the wrong piece of the
skin that x lies in, σ is summed at a few places, a random one in each stratum of √t. The rest is one texel of one map:
on the line along its direction d_k that crosses the ray at the pivot x + c ω, from `BEGIN` on, all of it in smoke:

    τ(x, ω) ≈ exp(−Σ w_i σ(x + t_i ω)) · τ_k(x + c ω − (c − BEGIN) d_k)

One of the four nearest directions and one of the four nearest texels is sampled by its bilinear weight: the mean is the
interpolated τ, and the many points of a pixel average.

In smoke the depths of neighbours differ by much of a mean free path, and the mean of τ is then brighter than the τ of
the mean depth. Two samples are read there. With depths A and B, e^(−(A + B)/2 − (A − B)²/8) has the expectation e^−E[A]
to third order in their standard deviation.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import ModuleType

import drjit as dr
import numpy as np

from ...core import spheres
from ...core.ops import dot
from .. import octahedral, ops, tuning
from ..backend import floats
from ..lights import LightTable
from ..profile import DepthProfile
from ..types import Array, Float, Mask, UInt32, Vector
from . import map_source, raymarch, two_logistics
from .method import Keep, Medium, Method, Options
from .transmittance_map import TransmittanceMap, channels

LOGISTICS = 2
"""Logistics per texel."""
RAYS = tuning.ATLAS_SIDE**2 * tuning.ATLAS_RESOLUTION**2
"""Number of texels of all maps."""
DARK = 3e-4
"""Transmittance of the map below which the sum close to x is skipped, and counts as clear."""
FAINT = 1e-30
"""Least transmittance whose logarithm is taken."""
KEYS = ((0x5BD1E995, 0x297A2D39), (0x68E31DA4, 0xB5297A4D), (0x1B56C4E9, 0x9E3779B1), (0x7FEB352D, 0x846CA68B))
"""Keys and factors of the words of random numbers after the first."""
OUTSIDE = 0.98
"""Squared distance from the origin, field units, beyond which points lie in no skin: maps are read from the sphere
on."""


class TransmittanceAtlas:
    """A density and maps of directions, read in two parts.

    Parameters
    ----------
    density
        σ at points, for the sum close to x.
    maps
        Maps of the directions of :func:`table`, made with `options`.
    begin
        Distance from x at which the maps begin, field units; 0 in smoke.
    march
        Method for lights inside the sphere, at which the maps do not end.

    Notes
    -----
    ``stream`` is the opaque seed of the random numbers of lookups, set by the renderer.
    """

    def __init__(self, density: Callable[[Vector], Float], maps: TransmittanceMap, begin: float,
                 march: raymarch.RayMarch, options: Options, dj: ModuleType):
        self.density, self.maps, self.march, self.options, self.dj = density, maps, march, options, dj
        self._begin, self._skin = dr.opaque(dj.Float, begin), begin > 0
        self._side = dr.opaque(dj.Float, maps.count**0.5)
        self._strata = max(tuning.STRATA, round(tuning.REACH / (tuning.STRATUM * options.step)))
        self.stream = dr.opaque(dj.UInt32, 0)

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the product of both parts; marched where the light lies inside the sphere.

        Kernels hold no march where `distance` is literally infinite.
        """
        here = spheres.coordinate(x, wi)
        if distance.state == dr.VarState.Literal and dr.all(distance == dr.inf)[0]:
            return self._look_up(x, wi, here, active)
        _, _, h = spheres.chord(ops, x, wi)

        def march(x: Vector, wi: Vector, distance: Float) -> Float:
            return self.march.tau(x, wi, distance, index, self.dj.Bool(True))

        def look_up(x: Vector, wi: Vector, distance: Float) -> Float:
            return self._look_up(x, wi, here, True)

        return ops.if_stmt((x, wi, distance), active & (here + distance < h), march, look_up, label="light inside")

    def _look_up(self, x: Vector, wi: Vector, here: Float, active: Mask) -> Float:
        """Return the product; 0 where not `active`: often no lane of a packet is lit."""
        if active is True:
            return self._product(x, wi, here)

        def dark(x: Vector, wi: Vector, here: Float) -> Float:
            return type(here)(0)

        return ops.if_stmt((tuple(x), tuple(wi), here), active, self._product, dark, label="lit")

    def _product(self, x: Vector, wi: Vector, here: Float) -> Float:
        outside = dr.squared_norm(self.dj.Array3f(*x)) > OUTSIDE
        *u, v = _uniforms(self.dj, self.stream, x, wi, 5 if self._skin else 9)
        if not self._skin:
            one, other = (-dr.log(dr.maximum(self._far(x, wi, here, outside, part), FAINT)) for part in (u[:4], u[4:]))
            return dr.exp(-0.5 * (one + other) - (one - other) ** 2 / 8)
        far = self._far(x, wi, here, outside, u)

        def near(far: Float, x: Vector, wi: Vector, v: Float) -> Float:
            return far * close_by(self.density, x, wi, v, self._strata)

        def dark(far: Float, x: Vector, wi: Vector, v: Float) -> Float:
            return far

        return ops.if_stmt((far, tuple(x), tuple(wi), v), ~outside & (far > DARK), near, dark, label="near")

    def _far(self, x: Vector, wi: Vector, here: Float, outside: Mask, u: Sequence[Float]) -> Float:
        k, d = self._direction(wi, u[:2])
        pivot = dr.select(outside, dr.maximum(-here, 0), dr.maximum(-tuning.PIVOT * here, tuning.NEAREST_PIVOT))
        back = dr.select(outside, pivot, pivot - self._begin)
        y = tuple(a + pivot * b for a, b in zip(x, wi, strict=True))
        return self.maps.tau_of_one(k, y, dot(y, d) - back, u[2:])

    def _direction(self, wi: Vector, u: Sequence[Float]) -> tuple[UInt32, Vector]:
        """Return index and direction of one of the four nearest, sampled by `u` (2)."""
        fu, fv = octahedral.place(wi, self._side)
        iu, iv = octahedral.wrap(dr.floor(fu + u[0]), dr.floor(fv + u[1]), self._side)
        return self.dj.UInt32(iv * self._side + iu), octahedral.direction(iu, iv, self._side)


def close_by(density: Callable[[Vector], Float], x: Vector, wi: Vector, v: Float, strata: int) -> Float:
    """Return an estimate of τ(x, ω) as far as ``REACH``, whose optical depth is right on average.

    σ is summed at one place in each stratum of √t, t = REACH ((v + i)/strata)², by one uniform number `v` per ray:
    skins thin out away from x, and strata of √t see each of their parts.
    """
    depth: Array = 0
    for i in range(strata):
        root = (v + i) * (1 / strata)
        t = tuning.REACH * root * root
        depth += root * density(tuple(a + t * b for a, b in zip(x, wi, strict=True)))
    return dr.exp((-2 * tuning.REACH / strata) * depth)


def _uniforms(dj: ModuleType, stream: UInt32, x: Vector, wi: Vector, count: int = 5) -> list[Float]:
    """Return `count` numbers in [0, 1), a function of the seed `stream` and the bits of a ray."""
    state = dj.UInt32(stream)
    for c, factor in zip((*x, *wi), (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1, 0xD3A2646D),
                         strict=True):
        word: Array = dr.reinterpret_array(dj.UInt32, c)
        state = (state ^ (word * factor)) * 0x2C1B3C6D
        state ^= state >> 15
    words = [state]
    for key, factor in KEYS[:(count - 1) // 2]:
        word = (words[-1] ^ key) * factor
        words.append(word ^ (word >> 15))
    halves = [half for word in words for half in (word & 0xFFFF, word >> 16)]
    return [dj.Float(half) * 2.0**-16 for half in halves[:count]]


def table(dj: ModuleType) -> LightTable:
    """Return the directions as a table of lights."""
    side = tuning.ATLAS_SIDE
    v, u = np.divmod(np.arange(side**2), side)
    d = np.stack(octahedral.direction(floats(u, dj), floats(v, dj), dj.Float(side)))
    where = np.array(d, np.float64).T
    return LightTable(where, np.ones((side**2, 3)), np.zeros(side**2, bool), 1.0, dj)


def build(medium: Medium, lights: LightTable | None, options: Options, dj: ModuleType,
          keep: Keep) -> TransmittanceAtlas:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    network = options.map_source == "network"
    step = options.step * tuning.ATLAS_STEP * (tuning.NETWORK_STEP if network else tuning.MAP_STEP)
    smoke = not medium.field.softness.opaque
    if smoke and not network:
        step = tuning.SMOKE_STEP
    profile = DepthProfile(medium.source, dr.opaque(dj.Float, step))
    source = (map_source.network_source(medium.field.network, profile, False) if network
              else map_source.table_source(profile) if smoke
              else map_source.field_source(medium.source, profile, LOGISTICS, two_logistics.ROUGH))
    directions = table(dj)
    options = replace(options, map_resolution=tuning.ATLAS_RESOLUTION, map_components=LOGISTICS, half=True)

    def make(values: np.ndarray | None = None) -> TransmittanceMap:
        return TransmittanceMap(directions, options.map_resolution, medium.field.grid.hull, source, dj, values, True)

    maps = keep(make, channels=channels(source.components, source.weights), step=step, directions=directions,
                options=options)
    march = raymarch.build(medium, lights, options, dj, keep)
    # The voxels' density serves the sum also where the medium is its networks.
    return TransmittanceAtlas(medium.field.grid.density, maps, 0.0 if smoke else tuning.BEGIN, march, options, dj)


def numbers(medium: Medium, lights: LightTable | None, options: Options) -> int:
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
