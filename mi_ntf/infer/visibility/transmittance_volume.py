"""``transmittance_volume``: per light, τ tabulated along the rays of its map, m × m × n.

Source: NRF (Bi et al. 2020), after deep shadow maps (Lokovic and Veach 2000).
"""

import math
from types import ModuleType

import drjit as dr
import numpy as np

from ...core import spheres
from ...core.errors import MiNtfError
from .. import ops
from ..bundle import density_where, safe_inverse
from ..grid import Density
from ..lights import LightTable
from ..tuning import MIN_MAP_RESOLUTION
from ..types import Array, Float, Mask, UInt32, Vector
from .light_rays import LightRays
from .method import Keep, Medium, Method, Options
from .raymarch import MAX_OPTICAL_DEPTH

FAINT = 1e-6
"""Least transmittance that is interpolated; rays end at e⁻¹²."""


class TransmittanceVolume:
    """Tables of τ for all lights of a table, `resolution`² rays of `depths` entries each.

    The entries of a ray divide t' ∈ [−R, R] evenly, R the radius of the hull of `volume`. Entry j holds τ at the *far*
    edge of the j-th cell from the light, so light that has passed no cell yet is 1. A lookup is linear in the optical
    depth along each of the four nearest rays, and bilinear in τ between them. Memory: 4 m² n bytes a light.
    """

    def __init__(self, lights: LightTable, resolution: int, depths: int, volume: Density, dj: ModuleType):
        self.dj, self.depths, self.volume, hull = dj, depths, volume, volume.hull
        self.rays = LightRays(lights, hull, resolution, dj)
        if lights.count * resolution**2 * depths >= 1 << 32:
            raise MiNtfError(
                f"transmittance_volume: {lights.count} lights of {resolution}² × {depths} entries exceed 2³²; "
                "lower map_resolution, samples or map_memory"
            )
        radius = min(1.0, float(np.linalg.norm(hull, axis=1).max()))
        self._radius, self._n = dr.opaque(dj.Float, radius), dr.opaque(dj.UInt32, depths)
        self._cell = dr.opaque(dj.Float, max(2 * radius / depths, 1e-6))
        self.values = dr.ones(dj.Float, lights.count * resolution**2 * depths)
        chunk = max(1, (1 << 22) // resolution**2)
        for first in range(0, lights.count, chunk):
            self._march(*self.rays.all_rays(first, min(chunk, lights.count - first)))
            dr.eval(self.values)

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the interpolated τ; 1 where light meets nothing."""
        inside, _, nearest = self.rays.nearest(index, x, wi, distance, active)
        inverse, last = dr.rcp(self._cell), self.dj.Float(self._n) - 1
        result: Float = 0
        for weight, texel, t in nearest:
            # Entry j is the far edge of cell j, t = R − (j + 1) Δ.
            place = dr.clip((self._radius - t) * inverse - 1, -1, last)
            j = dr.floor(place)
            first = texel * self._n + self.dj.UInt32(dr.maximum(j, 0))
            here = dr.select(j < 0, 1, dr.gather(self.dj.Float, self.values, first, inside))
            step = dr.select((j >= 0) & (j < last), self.dj.UInt32(1), 0)
            beyond = dr.gather(self.dj.Float, self.values, first + step, inside)
            result += weight * here * dr.power(dr.maximum(beyond, FAINT) / dr.maximum(here, FAINT), place - j)
        return dr.select(inside, result, 1)

    def _march(self, texel: UInt32, o: Vector, d: Vector, end: Float) -> None:
        """Fill the rays `texel` with τ, up to MAX_OPTICAL_DEPTH.

        σ is taken at the middle of each cell in occupied space, or of the cell's part on this side of the light at
        `end`. All entries begin as 1, so empty space before the first matter is skipped.
        """
        hit, m, h = spheres.chord(ops, o, d)
        inverse = safe_inverse(tuple(-c for c in d))

        def body(j: UInt32, depth: Float, active: Mask) -> tuple[Array, ...]:
            near = self._radius - self.dj.Float(j) * self._cell
            length = dr.clip(end - near + self._cell, 0, self._cell)
            t = near - self._cell + 0.5 * length
            place = self.volume.place(tuple(mi + t * di for mi, di in zip(m, d, strict=True)))
            clear = dr.select(dr.abs(t) < h, self.volume.clear_distance(place, inverse), dr.maximum(t - h, 0))
            matter = active & (dr.abs(t) < h) & (depth < MAX_OPTICAL_DEPTH) & (clear <= 0)
            depth = depth + density_where(matter, self.volume, place) * length
            dark = depth > 0
            dr.scatter(self.values, dr.exp(-depth), texel * self._n + j, active & dark)
            j += 1 + dr.select(dark, 0, self.dj.UInt32(dr.minimum(clear / self._cell, self._n)))
            return j, depth, active & (j < self._n) & (dark | (t > -h))

        zero = dr.zeros(self.dj.Float, dr.width(texel))
        state = (dr.zeros(self.dj.UInt32, dr.width(texel)), zero, hit & (self._n > 0))
        ops.while_loop(state=state, cond=lambda j, depth, active: active, body=body, label="transmittance volume")


def depths(options: Options) -> int:
    """Return the number of entries of a ray."""
    return math.ceil(2 / options.step)


def build(medium: Medium, table: LightTable, options: Options, dj: ModuleType, keep: Keep) -> TransmittanceVolume:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    return TransmittanceVolume(table, options.map_resolution, depths(options), medium.source, dj)


METHOD = Method(
    name="transmittance_volume",
    summary="per light, τ tabulated along the rays of its map",
    build=build,
    rays=lambda lights, resolution: lights * resolution**2,
    numbers=lambda medium, table, options: depths(options),
    dials=("map_resolution", "map_memory"),
    resolution=lambda lights, texels: max(MIN_MAP_RESOLUTION, texels // 2),  # memory grows with the third power
    sampled="raymarch",
)
