"""``transmittance_map``: per light, a 2-D table of the logistics of its rays.

Source: Shafiei et al. 2021, section 3.3, with the slips of its algorithms corrected.

A texel holds the parameters (a, b) of one of the light's rays (:mod:`mi_ntf.infer.visibility.light_rays`), or those of
a mixture. A lookup evaluates the four nearest rays, on a surface at equal depth in its skin, and interpolates the four
√τ bilinearly, never (a, b). The paper interpolates τ. At silhouettes, where density falls off exponentially, that lets
in too much light, and a mean of logarithms too little; the mean of roots lies between and has the least error.
"""

from collections.abc import Sequence
from types import ModuleType

import drjit as dr
import numpy as np

from ...core.mixture import Mixture
from .. import tuning
from ..lights import LightTable
from ..profile import DepthProfile
from ..texels import Texels, blank
from ..types import Array, Float, Mask, UInt32, Vector
from . import map_source, two_logistics
from .light_rays import LightRays
from .map_source import Source
from .method import Keep, Medium, Method, Options


def channels(components: int, weights: bool | None = None) -> int:
    """Return the float32 numbers of a texel.

    They are (a, b), or (w, a, b, 0) for each logistic of a mixture or where `weights` are stored.
    """
    return 4 * components if (components > 1 if weights is None else weights) else 2


class TransmittanceMap:
    """Maps of all lights of a table, at most m² texels each, one after the other in one Dr.Jit texture (`texels`).

    Parameters
    ----------
    hull
        (k, 3): points whose convex hull holds all density.
    values
        Stored :attr:`values` of such a map; None: the texels are computed from `source`.
    half
        Store half precision.

    Notes
    -----
    Memory: 8 m² bytes a light for one logistic, whose weight is 1 and not stored, 16 K m² for mixtures; half of that
    with `half`.
    """

    def __init__(self, lights: LightTable, resolution: int, hull: np.ndarray, source: Source, dj: ModuleType,
                 values: np.ndarray | None = None, half: bool = False):
        self.dj, self.lights, self.count = dj, lights, lights.count
        self.rays = LightRays(lights, hull, resolution, dj)
        self.width, self._tau = channels(source.components, source.weights), source.tau
        count = lights.count * resolution**2
        self.texels = Texels(self._fit(source, count) if values is None else values, count, self.width, dj, half)

    def _fit(self, source: Source, count: int) -> Float:
        """Return the numbers of all texels."""
        numbers, parts = blank(count, self.width, self.dj), max(1, self.width // 4)
        # A chunk of lights at a time bounds the memory of a source per ray.
        chunk = max(1, (1 << 22) // self.rays.m**2)
        for first in range(0, self.count, chunk):
            texel, o, d, end = self.rays.all_rays(first, min(chunk, self.count - first))
            mixture = source.fit(o, d, end)
            dr.eval(mixture)  # or each part's scatter would march again
            for k, part in enumerate(mixture):
                row = self.dj.Array2f(*part[1:]) if self.width == 2 else self.dj.Array4f(*part, 0)
                dr.scatter(numbers, row, texel * parts + k)
            dr.eval(numbers)
        return numbers

    @property
    def values(self) -> np.ndarray:
        """Numbers of all texels, `width` for each, m² texels a light."""
        return self.texels.numbers()

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the square of bilinear √τ of the four nearest texel rays; 1 where light meets nothing."""
        inside, size, nearest = self.rays.nearest(index, x, wi, distance, active)
        mixtures = [self._fetch(texel, inside) for _, texel, _ in nearest]
        shifts = _shifts(mixtures, [weight for weight, _, _ in nearest], size)
        root: Array = 0
        for (weight, _, t), shift, parts in zip(nearest, shifts, mixtures, strict=True):
            root += weight * _root(t + shift, parts)
        return dr.select(inside, dr.minimum(root * root, 1), 1)

    def tau_of_one(self, index: UInt32, x: Vector, t: Float, u: Sequence[Float]) -> Float:
        """Return τ at the place `t` of one of the four rays of directional light `index` nearest to `x`.

        The ray is sampled by its bilinear weight with the uniform numbers `u` (2); τ is 1 where light meets nothing.
        """
        inside, texel = self.rays.one(index, x, u)
        return dr.select(inside, dr.minimum(self._tau(t, self._fetch(texel, inside)), 1), 1)

    def _fetch(self, texel: UInt32, active: Mask) -> Mixture:
        row = self.texels.row(texel, active)
        if self.width == 2:
            return ((1.0, row[0], row[1]),)
        return tuple((row[k], row[k + 1], row[k + 2]) for k in range(0, self.width, 4))


def _root(t: Float, mixture: Mixture) -> Float:
    """Return √τ(t)."""
    if len(mixture) > 1:
        return dr.sqrt(map_source.mixture_tau(t, mixture))
    w, a, b = mixture[0]
    return dr.sqrt(w) * dr.rsqrt(1 + dr.exp(dr.clip(a * (b - t), -20, 80)))


def _shifts(mixtures: list[Mixture], weights: list[Float], size: Float) -> list[Float]:
    """Return the distance to move along each of the four rays before reading it; `size`: of a texel there.

    On a surface at a slant the four rays meet the same skin at different t', and averaging them blurs it. Where their
    centres c differ by few texels, each ray is therefore read as deep in its own skin as the point lies in the
    interpolated one: t' + c − Σ w c. Where they differ by more, at silhouettes, nothing is moved, which is the paper's
    rule; between `SAME_SURFACE` and `TWO_SURFACES` texels the shift fades out.
    """
    same, two = tuning.SAME_SURFACE, tuning.TWO_SURFACES
    centres = [sum((w * b for w, _, b in m[1:]), m[0][0] * m[0][2]) for m in mixtures]
    mean = sum(w * c for w, c in zip(weights, centres, strict=True))
    top, low = (f(f(centres[0], centres[1]), f(centres[2], centres[3])) for f in (dr.maximum, dr.minimum))
    fade = dr.clip((two - (top - low) / size) * (1 / (two - same)), 0, 1)
    return [fade * (c - mean) for c in centres]


def width(medium: Medium, table: LightTable, options: Options) -> int:
    """Return the float32 numbers of a texel."""
    if options.map_source == "field":
        return channels(options.map_components)
    components = medium.field.network.components
    return channels(components, components > 1 or _inside(table))


def _inside(table: LightTable) -> bool:
    """Return True if a light lies inside the sphere."""
    return bool((table.is_point & (np.linalg.norm(table.where, axis=1) < 1)).any())


def build(medium: Medium, table: LightTable, options: Options, dj: ModuleType, keep: Keep) -> TransmittanceMap:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    network = options.map_source == "network"
    # Two logistics follow a ray closely enough for the march's own error to show.
    step = options.step * (tuning.NETWORK_STEP if network else tuning.MAP_STEP / options.map_components)
    profile = DepthProfile(medium.source, dr.opaque(dj.Float, step))
    if network:
        source = map_source.network_source(medium.field.network, profile, _inside(table))
    else:
        effort = two_logistics.FINE if medium.field.softness.opaque else two_logistics.SMOKE
        source = map_source.field_source(medium.source, profile, options.map_components, effort)

    def make(values: np.ndarray | None = None) -> TransmittanceMap:
        return TransmittanceMap(table, options.map_resolution, medium.field.grid.hull, source, dj, values)

    def make_part(rows: np.ndarray) -> TransmittanceMap:
        return TransmittanceMap(table.chosen(rows), options.map_resolution, medium.field.grid.hull, source, dj)

    # The texels of a network depend on the places of all lights.
    return keep(make, channels=width(medium, table, options), step=step, make_part=None if network else make_part)


METHOD = Method(
    name="transmittance_map",
    summary="per light, a table of the logistics of its rays",
    build=build,
    rays=lambda lights, resolution: lights * resolution**2,
    numbers=width,
    dials=("map_resolution", "map_source", "map_components", "map_memory", "map_file"),
    sampled="raymarch",
    automatic=True,
)
