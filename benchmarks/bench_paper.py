"""The paper's comparison, in its own networks: transmittance map over transmittance volume (Shafiei et al. 2021, Table
1).

A query costs the same whatever its answer, so the networks have random weights and the paper's sizes
(:data:`mi_ntf.core.architecture.PAPER`). What the camera sees, and with it how many points are shaded, is the shipped
field: :class:`PaperField` adds a vanishing part of each query to the shipped field's value.

Costs are measured per network query, and the shares of queries that culling leaves on the shipped grid; the rows are
composed of them in :mod:`benchmarks.bench_culled`. Both sides of a ratio march, shade and query in kernels of one
size.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import spheres
from mi_ntf.core.architecture import PAPER, Architecture, Header
from mi_ntf.infer import march, ops, shade
from mi_ntf.infer.bundle import Strand, safe_inverse
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.profile import DepthProfile
from mi_ntf.infer.visibility.raymarch import MAX_OPTICAL_DEPTH

from .bench_measure import Sizes
from .loops import seconds, table_of

LIGHTS = 500
SIDE = 600
"""The paper's lights and image side."""
STAGE_SAMPLES = 64 + 192
"""Field queries a ray of the hierarchical quadrature: 64 coarse, then all 192 by the fine network."""
IMAGE_SAMPLES = 192
VANISHING = 1e-30


def random_network(hidden: tuple[int, ...], seed: int = 0) -> NetworkField:
    """The paper's three networks, of `hidden` layers, with random weights of the usual variance."""
    rng = np.random.default_rng(seed)
    network = replace(PAPER.density, hidden=hidden)
    architecture = Architecture(network, network, network)
    tensors = {}
    for name, shape in architecture.skeleton().items():
        scale = np.sqrt(2 / shape[-1]) if name.endswith("weight") else 0
        tensors[name] = (rng.normal(size=shape) * scale).astype(np.float32)
    return NetworkField(Header(architecture), tensors, mi)


class PaperField:
    """The values of `shape` (a :class:`mi_ntf.infer.grid.GridField`) at the price of `network`'s queries."""

    def __init__(self, shape, network: NetworkField):
        self.shape, self.network = shape, network
        self.hull = shape.hull

    def density(self, p):
        """σ at `p`."""
        return self.shape.density(p) + VANISHING * self.network.density(p)

    def place(self, p):
        """Return the points and their places in the shape."""
        return tuple(p), self.shape.place(p)

    def log_density(self, place):
        """Return ln σ at a place."""
        return self.shape.log_density(place[1]) + VANISHING * self.network.density(place[0])

    def clear_distance(self, place, inverse_d):
        """Return what the shape's does."""
        return self.shape.clear_distance(place[1], inverse_d)

    def reflectance(self, p):
        """Return the reflectance, as :meth:`mi_ntf.infer.network.NetworkField.reflectance` does."""
        pairs = zip(self.shape.reflectance(p), self.network.reflectance(p), strict=True)
        return tuple(tuple(u + VANISHING * v for u, v in zip(a, b, strict=True)) if isinstance(a, tuple)
                     else a + VANISHING * b for a, b in pairs)


def light_rays(lights: int, count: int):
    """``(o, d)`` of `count` rays in all, spread evenly over `lights` of the 500 directional lights and over the disc of
    each, radius 0.9."""
    index = np.arange(count)
    d = spheres.fibonacci(LIGHTS)[(index % lights) * (LIGHTS // lights)]
    r, phi = 0.9 * np.sqrt((index + 0.5) / count), index * np.pi * (3 - 5**0.5)
    side = np.cross(d, np.where(np.abs(d[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    o = r[:, None] * (np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * np.cross(d, side))
    rays = tuple(tuple(mi.Float(c) for c in v.T.astype(np.float32)) for v in (o, d))
    dr.eval(rays)
    return rays


def samples_of(o, d, samples: int):
    """``(p, step)``: the middles of `samples` even steps of each ray's chord, from the light on, all samples of a ray
    side by side; the steps' length."""
    count = dr.opaque(mi.UInt32, samples)
    index = dr.arange(mi.UInt32, dr.width(o[0]) * samples)
    ray = index // count
    o, d = (tuple(dr.gather(mi.Float, c, ray) for c in v) for v in (o, d))
    _, m, h = spheres.chord(ops, o, d)
    step = 2 * h / mi.Float(count)
    t = h - (mi.Float(index - ray * count) + 0.5) * step
    return tuple(mi_ + t * di for mi_, di in zip(m, d, strict=True)), step


def tabulate(density, o, d, samples: int):
    """τ at `samples` points along each ray from the light, flat: the work of a transmittance volume, all queries of a
    ray side by side."""
    p, step = samples_of(o, d, samples)
    return dr.exp(-dr.block_prefix_reduce(dr.ReduceOp.Add, density(p) * step, samples, exclusive=False))


def culled_shares(grid, sizes: Sizes) -> dict[str, float]:
    """Return the fractions of :func:`light_rays` of all lights that culling on the shipped grid leaves.

    ``share/256`` and ``share/192``: samples of a ray in occupied space, before τ passes e^−12. ``share/rays``: rays
    that meet any occupied space; a map is filled for these alone.
    """
    shares = {}
    for n in (IMAGE_SAMPLES, STAGE_SAMPLES):
        o, d = light_rays(LIGHTS, max(LIGHTS, sizes.queries // 8))
        p, step = samples_of(o, d, n)
        inverse = safe_inverse(tuple(dr.repeat(c, n) for c in d))
        occupied = dr.select(grid.clear_distance(grid.place(p), inverse) <= 0, mi.Float(1), 0)
        before = dr.block_prefix_reduce(dr.ReduceOp.Add, grid.density(p) * step, n, exclusive=True)
        asked = dr.select(before < MAX_OPTICAL_DEPTH, occupied, 0)
        shares[f"share/{n}"] = float(dr.mean(asked)[0])
        shares["share/rays"] = float(dr.mean(dr.block_reduce(dr.ReduceOp.Max, occupied, n))[0])
    return shares


def stage_costs(medium, network: NetworkField, sizes: Sizes) -> dict[str, float]:
    """Seconds a ray of a light's table: ``volume/256`` and ``volume/192`` samples, ``map`` by the paper's network,
    ``ours`` by the shipped one, its look at the shipped grid, a culled march, included. As many queries a kernel on
    either side. ``query``: seconds to ask for a point's reflectance, and with it for its density, which the paper's
    network gives at once. ``voxels``: seconds to bake such a grid from the paper's field."""
    grid = medium.field.grid
    profile = DepthProfile(grid, dr.opaque(mi.Float, 2 / 384))
    many = light_rays(sizes.slow_lights, sizes.queries)
    counts = {n: max(1, sizes.queries // n) for n in (STAGE_SAMPLES, IMAGE_SAMPLES)}
    few = {n: light_rays(sizes.slow_lights, count) for n, count in counts.items()}

    def mixture(net):
        return net.ray_mixture(*many, profile)[2]

    work: dict[str, Callable[[], Any]] = {}
    for n, (o, d) in few.items():
        work[f"volume/{n}"] = partial(tabulate, network.density, o, d, n)
    for name, net in (("map", network), ("ours", medium.field.network)):
        work[name] = partial(mixture, net)
    work["query"] = lambda: network.reflectance(many[0])
    found = seconds(work, sizes.repeats)
    rays = {f"volume/{n}": count for n, count in counts.items()}
    costs = {name: value / rays.get(name, sizes.queries) for name, value in found.items()}
    voxels = grid.resolution**3 * costs[f"volume/{IMAGE_SAMPLES}"] / IMAGE_SAMPLES
    return costs | {"voxels": voxels}


def camera_cost(sensor, medium, paper: PaperField, sizes: Sizes):
    """Seconds to march the rays of all pixels, empty space skipped, and to read the reflectance of what they meet; and
    these shading points."""
    o, d, far = view_rays(sensor, medium.frame, sizes.pixels)
    middle = dr.full(mi.Float, 0.5, dr.width(far))
    step = dr.opaque(mi.Float, 2 / IMAGE_SAMPLES)
    strand = Strand(paper, o, d, step)
    last: list[shade.Points] = []

    def view():
        found = march.camera_samples([strand], far, middle, middle)
        x, along = found.place(0, found.ray, found.t)
        matter = shade.Reflectance(*paper.reflectance(x), medium.field.softness(x))
        p = shade.Points(x, tuple(-c for c in along), matter)
        last[:] = [p]
        return [*p.x, *p.wo, *p.normal, *p.albedo, p.roughness, p.specular]

    return seconds({"camera": view}, sizes.repeats)["camera"], last[0]


def view_rays(sensor, frame, side: int):
    """``(o, d, length)``, field coordinates: rays through the middles of `side`² pixels of the whole picture."""
    index = dr.arange(mi.UInt32, side * side)
    y = index // dr.opaque(mi.UInt32, side)
    where = mi.Point2f((mi.Float(index - y * side) + 0.5) / side, (mi.Float(y) + 0.5) / side)
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), where, mi.Point2f(0.5))
    far = dr.full(mi.Float, 1e6, side * side)
    result = frame.point_to_field(ray.o), frame.direction_to_field(ray.d), far
    dr.eval(result)
    return result


def shading_costs(medium, points, sizes: Sizes) -> dict[str, float]:
    """``shade/volume`` and ``shade/map``: seconds a point and light to look up and to shade, under all lights. What the
    tables hold does not matter, so they are filled from the shipped grid."""
    from mi_ntf.render.maps import building

    count, *sides = sizes.tables
    table = table_of(spheres.fibonacci(count))
    built = {name: building.build(f"transmittance_{name}", medium, table, building.Options(2 / IMAGE_SAMPLES, side))
             for name, side in zip(("volume", "map"), sides, strict=True)}
    found = seconds({f"shade/{n}": partial(shade.reflect, points, table, v) for n, v in built.items()}, sizes.repeats)
    built.clear()
    dr.flush_malloc_cache()  # gigabytes
    return {n: v / max(dr.width(points.x[0]) * count, 1) for n, v in found.items()}


def costs_of(scene, medium, sizes: Sizes) -> dict[str, float]:
    """Return the measurements that the rows are computed from.

    Seconds (:func:`stage_costs`, :func:`shading_costs`; ``camera``: of a pixel), ``points``: shading points of a pixel,
    and fractions (:func:`culled_shares`).
    """
    network = random_network(sizes.hidden)
    costs = stage_costs(medium, network, sizes)
    camera, points = camera_cost(scene.sensors()[0], medium, PaperField(medium.field.grid, network), sizes)
    pixels = sizes.pixels**2
    costs |= {"camera": camera / pixels, "points": dr.width(points.x[0]) / pixels}
    return costs | shading_costs(medium, points, sizes) | culled_shares(medium.field.grid, sizes)
