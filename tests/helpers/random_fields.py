"""Random fields, lights and rays for property tests: baked ones, and ones whose optical depth is known exactly.

Every example is a batch drawn from a seed, of the same widths and the same code each time: one compilation a method.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import erf

from helpers import fields
from helpers.jit import arrays
from helpers.volumes import Formula
from mi_ntf.core import ops
from mi_ntf.infer import ops as infer_ops
from mi_ntf.infer import tuning
from mi_ntf.infer.grid import baked
from mi_ntf.infer.lights import LightTable
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.skin import measured
from mi_ntf.render.maps import building

METHODS = {
    "raymarch": ("raymarch", {}),
    "transmittance_volume": ("transmittance_volume", {}),
    "ray_network": ("ray_network", {}),
    "map, field": ("transmittance_map", {}),
    "map, field, 2": ("transmittance_map", {"map_components": 2}),
    "map, network": ("transmittance_map", {"map_source": "network"}),
    "visibility_mlp": ("visibility_mlp", {}),
    "atlas, field": ("transmittance_atlas", {}),
    "atlas, network": ("neural_transmittance", {}),
    "none": ("none", {}),
}
STEP = 2 / 256
"""Cells of the camera march that methods derive their own steps from."""
RESOLUTION = 48
"""Texels along the side of a map."""


@dataclass(frozen=True)
class Balls:
    """A field of up to six overlapping balls, some cut by the unit sphere. `wild`: the ray network has random weights;
    otherwise its outputs are 0, which is the logistic through the middle of a ray's profile. The baseline's network
    has them always."""

    seed: int
    count: int = 3
    log_density: float = 3.0
    wild: bool = False
    components: int = 2
    central: bool = False

    def medium(self, brighter: float = 1.0):
        """Return a stand-in for a medium, for :func:`mi_ntf.render.maps.building.build`; density times `brighter`."""
        return _balls(self, brighter)


@lru_cache(maxsize=24)
def _balls(what: Balls, factor: float):
    rng = np.random.default_rng(what.seed)
    centres = rng.uniform(-0.5, 0.5, (what.count, 3)) * (not what.central)
    header, tensors = fields.blobs(
        centres, rng.uniform(0.1, 0.45, what.count), log_density=what.log_density, edge=rng.uniform(1, 8),
        components=what.components, visibility=True,
    )  # fmt: skip
    tensors["density.layers.1.bias"][0] += np.log(factor)
    for name, values in tensors.items():
        if name.startswith("transmittance"):
            values[:] = rng.normal(size=values.shape) * 0.5 * what.wild
    network = NetworkField(header, tensors, mi)
    grid = baked(network, 48, mi)
    field = SimpleNamespace(network=network, grid=grid, softness=measured(grid, mi), trained=True)
    return SimpleNamespace(source=grid, field=field)


class Exact:
    """A slab, a ball and two Gaussians, σ each: optical depths in closed form, in float64. `kinds`: which of them have
    any density."""

    def __init__(self, seed: int, kinds=("slab", "ball", "points"), strength: float = 8.0):
        rng = np.random.default_rng(seed)
        normal = rng.normal(size=3)
        self.normal, self.place, self.half = normal / np.linalg.norm(normal), rng.uniform(-0.3, 0.3), 0.15
        self.centre, self.radius = rng.uniform(-0.3, 0.3, 3), rng.uniform(0.2, 0.5)
        self.points, self.sharp = rng.uniform(-0.4, 0.4, (2, 3)), rng.uniform(8, 60, 2)
        self.slab, self.ball = (rng.uniform(0.2, 1) * strength * (k in kinds) for k in ("slab", "ball"))
        self.peaks = rng.uniform(0.5, 2, 2) * strength * ("points" in kinds)
        numbers = [*self.normal, self.place, *self.centre, self.radius, *self.points.ravel(), *self.sharp]
        self._numbers = [dr.opaque(mi.Float, float(v)) for v in (*numbers, self.slab, self.ball, *self.peaks)]

    def density(self, p):
        """σ at `p` in Dr.Jit."""
        v = self._numbers
        along = sum(a * b for a, b in zip(v[:3], p, strict=True)) - v[3]
        inside = [sum((a - b) ** 2 for a, b in zip(v[i : i + 3], p, strict=True)) for i in (4, 8, 11)]
        sigma = dr.select(dr.abs(along) < self.half, v[16], 0) + dr.select(inside[0] < v[7] * v[7], v[17], 0)
        for r2, sharp, peak in zip(inside[1:], v[14:16], v[18:], strict=True):
            sigma += peak * dr.exp(-sharp * r2)
        return dr.select(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < 1, sigma, 0)

    def reflectance(self, p):
        """``(normal,)`` at `p`: of the slab in it, elsewhere away from the ball's centre or, out of the ball, from the
        nearer of the two points."""
        v = self._numbers
        along = sum(a * b for a, b in zip(v[:3], p, strict=True)) - v[3]
        away = [[a - b for a, b in zip(p, v[i : i + 3], strict=True)] for i in (4, 8, 11)]
        square = [x * x + y * y + z * z for x, y, z in away]
        in_slab, in_ball = (dr.abs(along) < self.half) & (v[16] > 0), (square[0] < v[7] * v[7]) & (v[17] > 0)
        near = [dr.select(square[1] < square[2], a, b) for a, b in zip(*away[1:], strict=True)]
        normal = [dr.select(in_slab, n, dr.select(in_ball, b, c)) for n, b, c in zip(v[:3], away[0], near, strict=True)]
        return (ops.normalize(infer_ops, tuple(normal)),)

    def optical_depth(self, x, d, length):
        """∫ σ from the points `x` (n, 3) along `d`, as far as `length` or the unit sphere."""
        begin, end = _inside(x, d, 1.0)
        begin, end = np.maximum(begin, 0), np.maximum(np.minimum(end, length), np.maximum(begin, 0))
        ends = np.stack([begin, end])
        low, high = _inside(x - self.centre, d, self.radius)
        depth = self.ball * np.diff(np.clip(ends, low, high), axis=0)[0]
        across = d @ self.normal
        across = np.where(np.abs(across) < 1e-12, 1e-12, across)
        first, last = np.sort(((self.place + np.array([[-1], [1]]) * self.half) - x @ self.normal) / across, axis=0)
        depth += self.slab * np.diff(np.clip(ends, first, last), axis=0)[0]
        for point, sharp, peak in zip(self.points, self.sharp, self.peaks, strict=True):
            rel = x - point
            b = (rel * d).sum(1)
            scale = peak * np.sqrt(np.pi / sharp) / 2 * np.exp(-sharp * ((rel * rel).sum(1) - b * b))
            depth += scale * np.diff(erf(np.sqrt(sharp) * (b + ends)), axis=0)[0]
        return depth

    def medium(self):
        """Return a stand-in for a medium, as :meth:`Balls.medium`, without empty space to skip."""
        corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)
        volume = Formula(self.density, corners)
        network = Balls(0).medium().field.network
        softness = SimpleNamespace(opaque=True, thickness=math.inf)
        field = SimpleNamespace(network=network, grid=volume, softness=softness, trained=True)
        volume.reflectance = self.reflectance
        return SimpleNamespace(source=volume, field=field)


def _inside(x, d, radius):
    """Return where the rays x + t d enter and leave the ball of `radius` around the origin; twice the nearest place if
    never."""
    b = (x * d).sum(1)
    h = np.sqrt(np.maximum(b * b - (x * x).sum(1) + radius**2, 0))
    return -b - h, -b + h


def unit(rng, n: int) -> np.ndarray:
    """(n, 3) uniform directions."""
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def lights(seed: int, scale: float = 1.0) -> LightTable:
    """Eight: three directional ones, of which one along an axis, and points near, at 10⁴, on the unit sphere, and two
    within."""
    rng = np.random.default_rng([seed, 1])
    d = unit(rng, 8)
    d[1] = [0, 0, -1]
    where = d * np.array([1, 1, 1, rng.uniform(1.2, 4), 1e4, 1, rng.uniform(0.6, 0.9), rng.uniform(0, 0.4)])[:, None]
    return LightTable(where, rng.uniform(0.5, 2, (8, 3)), np.arange(8) > 2, scale, mi)


def places(seed: int, table: LightTable, n: int = 256) -> np.ndarray:
    """(lights, n, 3) points in and around the unit sphere; of each light some on its line through the origin, and
    some whose way to it is parallel to an axis."""
    rng = np.random.default_rng([seed, 2])
    x = unit(rng, table.count * n).reshape(table.count, n, 3) * rng.uniform(0, 1.3, (table.count, n, 1)) ** 0.5
    axis = table.where / np.linalg.norm(table.where, axis=1, keepdims=True)
    x[:, :4] = np.linspace(-1, 0.5, 4)[None, :, None] * axis[:, None]
    x[table.is_point, 4:7] = np.where(np.eye(3, dtype=bool), 0.2, table.where[table.is_point, None])
    return x


def build(name: str, medium, table: LightTable, resolution: int = RESOLUTION, step: float = STEP):
    """The method `name` of METHODS; None for ``none``."""
    method, extra = METHODS[name]
    with pytest.MonkeyPatch.context() as patch:  # an atlas of two million rays takes seconds
        patch.setattr(tuning, "ATLAS_SIDE", 8)
        patch.setattr(tuning, "ATLAS_RESOLUTION", 16)
        return building.build(method, medium, table, building.Options(step, map_resolution=resolution, **extra))


def look(method, table: LightTable, x: np.ndarray, index=None) -> np.ndarray:
    """τ of the points x (lights, …, 3) under the light of their row (or `index`), float64."""
    rows = np.broadcast_to(np.arange(len(x)).reshape(-1, *[1] * (x.ndim - 2)), x.shape[:-1])
    index = mi.UInt32(np.ascontiguousarray(rows if index is None else index).ravel().astype(np.uint32))
    p = arrays(x.reshape(-1, 3))
    light = table.sample(index, p, True)
    if method is None:
        return np.ones(x.shape[:-1])
    tau = method.tau(p, light.wi, light.distance, index, dr.full(mi.Bool, True, dr.width(p[0])))
    return np.array(tau, np.float64).reshape(x.shape[:-1])


def towards(table: LightTable, x: np.ndarray):
    """Unit vectors (lights, n, 3) and distances (lights, n) from the points to their row's light."""
    point = table.is_point[:, None, None]
    d = np.where(point, table.where[:, None] - x, table.where[:, None])
    r = np.linalg.norm(d, axis=-1)
    return d / np.maximum(r, 1e-30)[..., None], np.where(point[..., 0], r, np.inf)
