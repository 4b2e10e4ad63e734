"""The paper's comparison of transmittance maps with volumes, by networks of its size (Shafiei et al. 2021, table 1).

A query costs the same whatever its answer, so the networks have random weights. The density that the camera sees, and
so the number of shading points, is that of the shipped field: :class:`PaperField` adds a vanishing part of each query
to the value of that field. Costs are measured per query and per lookup; the times of 500 lights are composed of them.

*Unculled*, as in the paper: every ray of every table and every sample of a camera ray is queried. *Culled*: no side
queries empty space, nor where the transmittance has fallen to e^−12. A volume skips samples, a map whole rays. Both
sides then pay for the voxels that tell where space is empty. Our own network reads a culled march, so its rays cost the
same in both cases, and it pays for the voxels in both.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import spheres
from mi_ntf.core.architecture import PAPER, Architecture, Header
from mi_ntf.infer import march, ops, shade
from mi_ntf.infer.bundle import Strand, safe_inverse
from mi_ntf.infer.grid import InSphere
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.profile import DepthProfile
from mi_ntf.infer.visibility.raymarch import MAX_OPTICAL_DEPTH
from mi_ntf.render.maps import building

from .timing import rounds, table_of

LIGHTS, SIDE = 500, 600
"""The paper's lights, and pixels along a side of its pictures."""
STAGE_SAMPLES = 64 + 192
"""Queries of a ray of the hierarchical quadrature: 64 coarse ones, then all 192 of the fine network."""
IMAGE_SAMPLES = 192
VANISHING = 1e-30
Costs = dict[str, float]
"""Costs of one round, by name; see :func:`costs_of`."""
MAP, OURS = "map", "ours"
"""Tables that are compared with a volume: maps by a network of the paper's size, and by our own."""
CASES = {"unculled": (MAP, False, "network of the paper's size, unculled on both sides"),
         "culled": (MAP, True, "network of the paper's size, culled on both sides"),
         "own_unculled": (OURS, False, "our network, which reads a culled march; volume unculled"),
         "own_culled": (OURS, True, "our network, culled on both sides")}
"""Key → table, culling and words of a comparison."""


@dataclass(frozen=True)
class Sizes:
    """Amounts that are measured.

    - hidden: widths of the networks' layers: the paper's
    - queries: network queries of a kernel
    - repeats: timed rounds after one that compiles
    - slow_lights: number of lights that stand for all 500
    - pixels: side of the picture that stands for 600² pixels
    - map_sides: texels along the side of maps: one for each pixel of the paper, and ours
    - tables: lights, and sides of volume and map, for shading: at full size no cache of a processor holds them
    """

    hidden: tuple[int, ...] = PAPER.density.hidden
    queries: int = 1 << 17
    repeats: int = 5
    slow_lights: int = 5
    pixels: int = 150
    map_sides: tuple[int, int] = (SIDE, 128)
    tables: tuple[int, int, int] = (LIGHTS, 64, 256)


FULL = Sizes()
QUICK = Sizes(hidden=(16,), queries=1 << 10, repeats=2, pixels=12, tables=(20, 8, 16))


def random_network(hidden: tuple[int, ...], seed: int = 0) -> NetworkField:
    """Return the paper's three networks with these layers and random weights of the usual variance."""
    rng = np.random.default_rng(seed)
    network = replace(PAPER.density, hidden=hidden)
    architecture = Architecture(network, network, network)
    tensors = {}
    for name, shape in architecture.skeleton().items():
        scale = np.sqrt(2 / shape[-1]) if name.endswith("weight") else 0
        tensors[name] = (rng.normal(size=shape) * scale).astype(np.float32)
    return NetworkField(Header(architecture), tensors, mi)


class PaperField(InSphere):
    """A field with the values of `shape` (:class:`mi_ntf.infer.grid.GridField`) at the price of a network's queries."""

    def __init__(self, shape: Any, network: NetworkField):
        self.shape, self.network = shape, network
        self.hull = shape.hull

    def density(self, p: Any) -> Any:
        """Return the density at `p`."""
        return self.shape.density(p) + VANISHING * self.network.density(p)

    def place(self, p: Any) -> Any:
        """Return the points and their places in the shape."""
        return tuple(p), self.shape.place(p)

    def log_density(self, place: Any) -> Any:
        """Return the logarithm of the density at a place."""
        return self.shape.log_density(place[1]) + VANISHING * self.network.density(place[0])

    def clear_distance(self, place: Any, inverse_d: Any) -> Any:
        """Return the clear distance of the shape."""
        return self.shape.clear_distance(place[1], inverse_d)

    def reflectance(self, p: Any) -> Any:
        """Return the reflectance as :meth:`mi_ntf.infer.network.NetworkField.reflectance` does."""
        pairs = zip(self.shape.reflectance(p), self.network.reflectance(p), strict=True)
        return tuple(tuple(u + VANISHING * v for u, v in zip(a, b, strict=True)) if isinstance(a, tuple)
                     else a + VANISHING * b for a, b in pairs)


def light_rays(lights: int, count: int) -> Any:
    """Return origins and directions of `count` rays, spread evenly over `lights` of the 500 directional lights.

    The rays of a light start on a disc of radius 0.9.
    """
    index = np.arange(count)
    d = spheres.fibonacci(LIGHTS)[(index % lights) * (LIGHTS // lights)]
    r, phi = 0.9 * np.sqrt((index + 0.5) / count), index * np.pi * (3 - 5**0.5)
    side = np.cross(d, np.where(np.abs(d[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    o = r[:, None] * (np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * np.cross(d, side))
    rays = tuple(tuple(mi.Float(c) for c in v.T.astype(np.float32)) for v in (o, d))
    dr.eval(rays)
    return rays


def samples_of(o: Any, d: Any, samples: int) -> Any:
    """Return the middles of `samples` even steps of each ray's chord, and the steps' length.

    They are ordered by ray, and from the light on.
    """
    count = dr.opaque(mi.UInt32, samples)
    index = dr.arange(mi.UInt32, dr.width(o[0]) * samples)
    ray = index // count
    o, d = (tuple(dr.gather(mi.Float, c, ray) for c in v) for v in (o, d))
    _, m, h = spheres.chord(ops, o, d)
    step = 2 * h / mi.Float(count)
    t = h - (mi.Float(index - ray * count) + 0.5) * step
    return tuple(mi_ + t * di for mi_, di in zip(m, d, strict=True)), step


def tabulate(density: Callable[[Any], Any], o: Any, d: Any, samples: int) -> Any:
    """Return the transmittance at `samples` points along each ray, flat: the work of a transmittance volume."""
    p, step = samples_of(o, d, samples)
    return dr.exp(-dr.block_prefix_reduce(dr.ReduceOp.Add, density(p) * step, samples, exclusive=False))


def culled_fractions(grid: Any, sizes: Sizes) -> Costs:
    """Return the fractions of :func:`light_rays` of all lights that culling on the shipped grid leaves.

    ``fraction/256`` and ``fraction/192`` count samples in occupied space where the optical depth is still below 12.
    ``fraction/rays`` counts rays that meet any occupied space; a map is filled for these alone.
    """
    fractions: Costs = {}
    for n in (IMAGE_SAMPLES, STAGE_SAMPLES):
        o, d = light_rays(LIGHTS, max(LIGHTS, sizes.queries // 8))
        p, step = samples_of(o, d, n)
        inverse = safe_inverse(tuple(dr.repeat(c, n) for c in d))
        occupied = dr.select(grid.clear_distance(grid.place(p), inverse) <= 0, mi.Float(1), 0)
        before = dr.block_prefix_reduce(dr.ReduceOp.Add, grid.density(p) * step, n, exclusive=True)
        queried = dr.select(before < MAX_OPTICAL_DEPTH, occupied, 0)
        fractions[f"fraction/{n}"] = float(dr.mean(queried)[0])
        fractions["fraction/rays"] = float(dr.mean(dr.block_reduce(dr.ReduceOp.Max, occupied, n))[0])
    return fractions


def view_rays(sensor: Any, frame: Any, side: int) -> Any:
    """Return origins, directions and lengths of rays through the middles of `side`² pixels, in field coordinates."""
    index = dr.arange(mi.UInt32, side * side)
    y = index // dr.opaque(mi.UInt32, side)
    where = mi.Point2f((mi.Float(index - y * side) + 0.5) / side, (mi.Float(y) + 0.5) / side)
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), where, mi.Point2f(0.5))
    far = dr.full(mi.Float, 1e6, side * side)
    result = frame.point_to_field(ray.o), frame.direction_to_field(ray.d), far
    dr.eval(result)
    return result


def costs_of(scene: Any, medium: Any, sizes: Sizes) -> list[Costs]:
    """Return the costs of each timed round, in seconds.

    ``volume/256``, ``volume/192``
        a ray of a volume with so many samples, by the paper's network
    ``map``, ``ours``
        a ray of a map by the paper's network, and by our own with its culled march through the shipped grid
    ``query``
        a query of density and reflectance
    ``voxels``
        baking the shipped grid's voxels from the paper's network
    ``camera``
        marching a pixel's ray, empty space skipped, and reading the reflectance of its shading points
    ``shade/volume``, ``shade/map``
        looking up and shading a point and light, under all lights

    Three are no times: ``points``, shading points of a pixel, and those of :func:`culled_fractions`.
    """
    network, grid = random_network(sizes.hidden), medium.field.grid
    times, count = _camera_times(scene.sensors()[0], medium, PaperField(grid, network), sizes)
    times |= _query_times(medium, network, sizes)
    constants = {"points": count / sizes.pixels**2, **culled_fractions(grid, sizes)}
    result = []
    for k in range(sizes.repeats):
        costs = {name: values[k] for name, values in times.items()}
        costs["voxels"] = grid.resolution**3 * costs[f"volume/{IMAGE_SAMPLES}"] / IMAGE_SAMPLES
        result.append(costs | constants)
    return result


def _query_times(medium: Any, network: NetworkField, sizes: Sizes) -> dict[str, list[float]]:
    """Return the seconds of a ray and of a query, by round; kernels hold as many queries on either side."""
    profile = DepthProfile(medium.field.grid, dr.opaque(mi.Float, 2 / 384))
    many = light_rays(sizes.slow_lights, sizes.queries)
    rays = {f"volume/{n}": max(1, sizes.queries // n) for n in (STAGE_SAMPLES, IMAGE_SAMPLES)}
    work: dict[str, Callable[[], Any]] = {}
    for n in (STAGE_SAMPLES, IMAGE_SAMPLES):
        o, d = light_rays(sizes.slow_lights, rays[f"volume/{n}"])
        work[f"volume/{n}"] = partial(tabulate, network.density, o, d, n)
    for name, net in ((MAP, network), (OURS, medium.field.network)):
        work[name] = lambda net=net: net.ray_mixture(*many, profile)[2]  # type: ignore[misc]
    work["query"] = lambda: network.reflectance(many[0])
    times = rounds(work, sizes.repeats)
    return {name: [v / rays.get(name, sizes.queries) for v in values] for name, values in times.items()}


def _camera_times(sensor: Any, medium: Any, paper: PaperField, sizes: Sizes) -> tuple[dict[str, list[float]], int]:
    """Return the seconds of ``camera`` and ``shade/…`` by round, and the number of shading points."""
    o, d, far = view_rays(sensor, medium.frame, sizes.pixels)
    middle = dr.full(mi.Float, 0.5, dr.width(far))
    field: Any = paper
    strand = Strand(field, o, d, dr.opaque(mi.Float, 2 / IMAGE_SAMPLES))
    last: list[shade.Points] = []

    def view() -> list[Any]:
        samples = march.camera_samples([strand], far, middle, middle)
        x, along = samples.place(0, samples.ray, samples.t)
        normal, albedo, roughness, specular = paper.reflectance(x)
        matter = shade.Reflectance(normal, albedo, roughness, specular, medium.field.softness(x))
        p = shade.Points(x, tuple(-c for c in along), matter)
        last[:] = [p]
        return [*p.x, *p.wo, *p.normal, *p.albedo, p.roughness, *p.specular]

    camera = [v / sizes.pixels**2 for v in rounds({"camera": view}, sizes.repeats)["camera"]]
    count, *sides = sizes.tables
    table, points = table_of(spheres.fibonacci(count)), last[0]
    # The values that the tables hold do not matter, so the shipped grid fills them.
    built = {name: building.build(f"transmittance_{name}", medium, table, building.Options(2 / IMAGE_SAMPLES, side))
             for name, side in zip(("volume", "map"), sides, strict=True)}
    times = rounds({f"shade/{n}": partial(shade.reflect, points, table, v) for n, v in built.items()}, sizes.repeats)
    built.clear()
    dr.flush_malloc_cache()  # gigabytes
    width = dr.width(points.x[0])
    each = {name: [v / max(width * count, 1) for v in values] for name, values in times.items()}
    return {"camera": camera, **each}, width


def _ray(costs: Costs, table: str, culled: bool) -> float:
    """Return the seconds of a ray of a light's table."""
    if not culled or table == OURS:
        return costs[table]
    return costs[table] * costs["fraction/rays" if table == MAP else table.replace("volume", "fraction")]


def stage(costs: Costs, lights: Any, table: str, culled: bool, samples: int = STAGE_SAMPLES,
          texels: int = SIDE**2) -> tuple[Any, Any]:
    """Return the seconds of the transmittance of all lights, by maps and by volumes.

    `lights` is their number, or an array of numbers; `samples` are those of a volume's ray; `texels` are rays a light.
    """
    rays = lights * texels
    needs_voxels = culled or table == OURS
    return (rays * _ray(costs, table, culled) + needs_voxels * costs["voxels"],
            rays * _ray(costs, f"volume/{samples}", culled) + culled * costs["voxels"])


def whole(costs: Costs, lights: Any, table: str, culled: bool, side: int = SIDE) -> tuple[Any, Any]:
    """Return the seconds of a whole picture of 600² pixels, by maps of `side`² texels and by volumes.

    `lights` is their number, or an array of numbers.
    """
    needs_voxels = culled or table == OURS  # with them, camera rays are culled on both sides
    camera = SIDE**2 * (costs["camera"] if needs_voxels else IMAGE_SAMPLES * costs["query"])
    points = SIDE**2 * (costs["points"] if needs_voxels else IMAGE_SAMPLES)
    tables = ((table, costs["shade/map"], needs_voxels), (f"volume/{IMAGE_SAMPLES}", costs["shade/volume"], culled))
    by_map, by_volume = (camera + voxels * costs["voxels"] + lights * (points * shading
                         + side**2 * _ray(costs, name, culled)) for name, shading, voxels in tables)
    return by_map, by_volume
