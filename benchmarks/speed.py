"""Speed of maps, volumes, networks and whole pictures of the scene ``statue``: ``results/speed.json``, ``speed.png``.

    python -m benchmarks.speed

Medians after a warm-up that compiles; the two sides of a ratio are measured in turn. Each figure has a key, words, a
unit, and median, least and largest of its repeats. One that stands for more than was measured says from what it was
extrapolated. Takes about 15 minutes on two cores.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import files, spheres
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.infer import march, shade, tuning
from mi_ntf.infer.bundle import Strand
from mi_ntf.infer.grid import NetworkVolume
from mi_ntf.render.maps import building

from . import networks, one_image, record, scenes, timing
from .networks import LIGHTS
from .one_image import SAMPLES
from .timing import rounds, table_of

METHODS = ("raymarch", "transmittance_volume", "transmittance_map", "transmittance_atlas", "neural_transmittance",
           "ray_network")
MEMORY = 4096.0
"""Memory for maps in MiB, so that no method renders in parts."""
STEP, FINE = 2 / 384, 2 / 1536
"""Steps of the camera's march and of the atlas; steps of the reference's march and of the maps of the error figures."""
Figures = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Sizes(networks.Sizes):
    """Amounts that are measured, besides those of :class:`benchmarks.networks.Sizes`.

    - image: side of pictures that are rendered whole
    - skies: columns and rows of environments, from 1 light to the paper's 500
    - many: columns and rows of a large environment
    - map: texels along a side of our maps
    - error_image: side of the picture whose errors are measured
    - error_lights: its directional lights
    - error_map: texels along a side of its maps
    - single_lights: number of lights whose own errors are measured
    - field_image: side of the picture that every method renders
    - field_lights: columns and rows of its environment
    - setting_points: shading points of the loops over a field of voxels, and over one of networks
    - atlas: texels along a side of an atlas's maps; 0 for the default
    """

    image: int = 600
    skies: tuple[tuple[int, int], ...] = ((1, 1), (10, 5), (20, 5), (25, 10), (50, 10))
    many: tuple[int, int] = (128, 64)
    map: int = 128
    error_image: int = 128
    error_lights: int = 50
    error_map: int = 256
    single_lights: int = 12
    field_image: int = 200
    field_lights: tuple[int, int] = (10, 5)
    setting_points: tuple[int, int] = (1 << 14, 1 << 11)
    atlas: int = 0


FULL = Sizes()
QUICK = replace(Sizes(**vars(networks.QUICK)), image=16, skies=((1, 1), (4, 2), (5, 4)), many=(6, 4), map=16,
                error_image=12, error_lights=2, error_map=16, single_lights=2, field_image=12, field_lights=(2, 1),
                setting_points=(1 << 8, 1 << 5), atlas=4)


def figure(title: str, unit: str, values: list[float], extrapolated: str = "", **details: Any) -> dict[str, Any]:
    """Return a figure of repeated measurements."""
    more = {"extrapolated": extrapolated} if extrapolated else {}
    return {"title": title, "unit": unit, **record.spread(values), **more, **details}


def measure(sizes: Sizes, say: Callable[[str], None] = lambda text: None) -> Figures:
    """Return all figures; `say` is called with the title of each part before it is measured."""
    scene = scenes.under_sky(sizes.image)
    medium = scenes.medium_of(scene)
    parts: dict[str, Callable[[], Figures]] = {
        "the paper's networks": lambda: network_figures(networks.costs_of(scene, medium, sizes), sizes),
        "lookup of a map": lambda: lookup_figures(medium, sizes),
        "error of maps": lambda: map_error_figures(scenes.under_sky(sizes.error_image), sizes),
        "error under single lights": lambda: light_error_figures(scene, medium, sizes),
        "all methods on one field": lambda: method_figures(scene, medium, sizes),
        "fields of voxels and of networks": lambda: setting_figures(medium, sizes),
        "a light at the camera": lambda: camera_light_figures(sizes),
        "1 to 500 lights": lambda: scaling_figures(sizes),
        "first picture of a process": lambda: first_figures(sizes),
        "many lights": lambda: many_figures(sizes),
    }
    figures: Figures = {}
    with _atlas(sizes.atlas):
        for title, part in parts.items():
            say(title)
            figures |= part()
    return figures


@contextmanager
def _atlas(resolution: int) -> Any:
    """Make atlases of maps of `resolution`² texels within the block, unless it is 0."""
    before = tuning.ATLAS_RESOLUTION
    tuning.ATLAS_RESOLUTION = resolution or before
    try:
        yield
    finally:
        tuning.ATLAS_RESOLUTION = before


def network_figures(rows: list[networks.Costs], sizes: Sizes) -> Figures:
    """Return how much faster maps are than volumes, composed of the costs of each round."""
    rays = max(1, sizes.queries // networks.STAGE_SAMPLES)
    figures: Figures = {}
    for key, (table, culled, words) in networks.CASES.items():
        seconds = [networks.stage(costs, LIGHTS, table, culled) for costs in rows]
        figures[f"stage_{key}"] = figure(
            f"transmittance of {LIGHTS} lights, 600² rays each, volume over map, {words}", "×",
            [volume / tmap for tmap, volume in seconds], f"volume: {sizes.slow_lights} lights, {rays} rays in all")
        for side in sizes.map_sides:
            seconds = [networks.whole(costs, LIGHTS, table, culled, side) for costs in rows]
            figures[f"whole_{key}_{side}"] = figure(
                f"whole picture of 600² pixels, {LIGHTS} lights, maps of {side}² texels, volume over map, {words}", "×",
                [volume / tmap for tmap, volume in seconds],
                f"tables: {sizes.slow_lights} lights; {sizes.pixels}² pixels; shading under {sizes.tables[0]} lights")
    for name in ("256", "192", "rays"):
        words = "rays of a map" if name == "rays" else f"samples of a volume, {name} a ray"
        figures[f"culling_{name}"] = figure(f"fraction that culling leaves of the {words}", "%",
                                            [100 * rows[0][f"fraction/{name}"]])
    figures["costs"] = {"title": "costs of a query, a lookup or a pixel", "unit": "s", "rounds": rows}
    return figures


def lookup_figures(medium: Any, sizes: Sizes) -> Figures:
    """Return the time of one lookup: the shading loop with a map less the loop without, by kinds of lights and maps.

    Four bare gathers in place of the lookup show what its memory traffic costs.
    """
    count, width = 10 * sizes.slow_lights, max(1 << 10, sizes.queries // 4)
    points, d = _inside(medium, width), spheres.fibonacci(count)
    tables = {"": table_of(d), "_point": table_of(2.5 * d, True), "_near_point": table_of(0.5 * d, True)}
    tables["_two_logistics"] = tables[""]
    words = {"": "a map", "_point": "a map of a point light", "_near_point": "a map of a light inside the sphere",
             "_two_logistics": "a map of two logistics a texel"}
    work = {"gathers": partial(shade.reflect, points, tables[""], Gathers(count, sizes.map))}
    for name, table in tables.items():
        options = building.Options(STEP, sizes.map, map_components=2 if name == "_two_logistics" else 1)
        tmap = building.build("transmittance_map", medium, table, options)
        work |= {f"map{name}": partial(shade.reflect, points, table, tmap),
                 f"none{name}": partial(shade.reflect, points, table, _Everything())}
    times = rounds(work, max(sizes.repeats, 3))

    def difference(one: str, other: str) -> list[float]:
        return [1e9 * (a - b) / (width * count) for a, b in zip(times[one], times[other], strict=True)]

    figures = {"gathers": figure("four bare gathers at the place of a lookup, per point and light", "ns",
                                 difference("gathers", "none"))}
    return figures | {f"lookup{name}": figure(f"lookup of {words[name]} in the shading loop, per point and light", "ns",
                                              difference(f"map{name}", f"none{name}")) for name in tables}


def _inside(medium: Any, count: int) -> shade.Points:
    """Return `count` shading points at random in the box around the object."""
    low, high = medium.field.grid.bounds
    where = low + np.random.default_rng(0).uniform(size=(count, 3)) * (high - low)
    x = tuple(mi.Float(c) for c in where.T.astype(np.float32))
    dr.eval(x)
    wo = tuple(dr.full(mi.Float, c, count) for c in (0.0, 0.6, 0.8))
    points = shade.Points(x, wo, medium.reflectance(x))
    points.evaluate()
    return points


class _Everything:
    """A visibility of 1 everywhere, which costs nothing."""

    def tau(self, x: Any, wi: Any, distance: Any, index: Any, active: Any, sun: Any = None) -> Any:
        return dr.select(active, mi.Float(1), 0)


class Gathers:
    """A visibility with the memory traffic of a map of one logistic: the pairs of the four nearest texels."""

    def __init__(self, lights: int, m: int):
        self.m = dr.opaque(mi.UInt32, m)
        self.values = dr.opaque(mi.Float, 1, lights * m * m * 2)  # a literal would be folded into the kernel

    def tau(self, x: Any, wi: Any, distance: Any, index: Any, active: Any, sun: Any = None) -> Any:
        """Return the mean of the four pairs' entries: 1."""
        last = mi.Float(self.m) - 2
        u = mi.UInt32(dr.clip((0.5 * (x[0] * wi[1] - x[1] * wi[0]) + 0.5) * last, 0, last))
        v = mi.UInt32(dr.clip((0.5 * x[2] + 0.5) * last, 0, last))
        first = (mi.UInt32(index) * self.m + v) * self.m + u
        pair: Any = mi.Array2f
        pairs = [dr.gather(pair, self.values, first + k, active) for k in (0, 1, self.m, self.m + 1)]
        return 0.125 * sum(p[0] + p[1] for p in pairs)


def map_error_figures(scene: Any, sizes: Sizes) -> Figures:
    """Return the errors of pictures by maps that are marched from the field, against a fine march."""
    lit = scenes.with_lights(scene, sizes.error_lights)
    fine: dict[str, Any] = {"samples": 1536}
    tmap = {"visibility": "transmittance_map", "map_resolution": sizes.error_map, **fine}
    kinds = {"fine": fine | {"visibility": "raymarch"}, "one": tmap, "two": tmap | {"map_components": 2}}
    images = {kind: scenes.picture(lit, scenes.integrator(**properties), 0, 4)[0]
              for kind, properties in kinds.items()}
    truth = images.pop("fine")
    return {f"map_error_{kind}": figure(
        f"relative RMSE of maps of {sizes.error_map}² texels, {kind} logistic{'s' if kind == 'two' else ''} a texel, "
        f"to a march, {sizes.error_lights} lights", "%", [100 * relative_rmse(image, truth)])
        for kind, image in images.items()}


class Picture:
    """Shading points of a field that a camera sees, and their weights, for `side`² pixels of four rays."""

    def __init__(self, scene: Any, medium: Any, side: int):
        o, d, far = networks.view_rays(scene.sensors()[0], medium.frame, 2 * side)
        rng = np.random.default_rng(0)
        offset, depth = (mi.Float(rng.random(4 * side**2, np.float32)) for _ in range(2))
        samples = march.camera_samples([Strand(medium.field.grid, o, d, dr.opaque(mi.Float, STEP))], far, offset, depth)
        x, along = samples.place(0, samples.ray, samples.t)
        self._samples, self._side = samples, side
        self._points = shade.Points(x, tuple(-c for c in along), medium.reflectance(x))
        self._points.evaluate()

    def images(self, table: Any, visibility: Any) -> list[np.ndarray]:
        """Return the radiance (pixels, 3) under each light of `table` alone."""
        lights = [_One(table, visibility, k) for k in range(table.count)]
        return [self.image(light, light) for light in lights]

    def image(self, table: Any, visibility: Any) -> np.ndarray:
        """Return the radiance (pixels, 3) under all lights of `table`."""
        values = shade.reflect(self._points, table, visibility)
        weighted = [c * self._samples.weights[0] for c in values]
        dr.eval(weighted)
        rays = np.array(self._samples.totals(weighted)).T.reshape(self._side, 2, self._side, 2, 3)
        return rays.mean((1, 3)).reshape(-1, 3)


class _One:
    """The light `k` of a table, as a table and a visibility of one light."""

    count, far, moving = 1, False, False

    def __init__(self, table: Any, visibility: Any, k: int):
        self._table, self._visibility, self._k = table, visibility, dr.opaque(mi.UInt32, k)

    def sample(self, index: Any, x: Any, active: Any) -> Any:
        return self._table.sample(index + self._k, x, active)

    def tau(self, x: Any, wi: Any, distance: Any, index: Any, active: Any, sun: Any = None) -> Any:
        return self._visibility.tau(x, wi, distance, index + self._k, active)


def light_error_figures(scene: Any, medium: Any, sizes: Sizes) -> Figures:
    """Return the errors under one light at a time, which partly cancel in the sum of many lights.

    The reference is a fine march on the same shading points, so only the transmittance of the light differs.
    """
    picture, table = Picture(scene, medium, sizes.error_image), table_of(spheres.fibonacci(sizes.single_lights))
    truth = picture.images(table, building.build("raymarch", medium, table, building.Options(FINE)))
    lit = [i for i, image in enumerate(truth) if image.any()]
    methods = {f"map_{words}": (f"maps of {sizes.error_map}² texels and {words} logistic{'s' * (n > 1)} a texel",
                                "transmittance_map", building.Options(FINE, sizes.error_map, map_components=n))
               for n, words in ((1, "one"), (2, "two"))}
    methods["atlas"] = "the atlas", "transmittance_atlas", building.Options(STEP)
    figures: Figures = {}
    for key, (title, name, options) in methods.items():
        images = picture.images(table, building.build(name, medium, table, options))
        each = [100 * relative_rmse(images[i], truth[i]) for i in lit] or [0.0]
        total = 100 * relative_rmse(np.sum(images, 0), np.sum(truth, 0)) if lit else 0.0
        figures[f"light_error_{key}"] = figure(
            f"relative RMSE of {title} to a march on the same points, under each of {len(lit)} lights alone", "%", each,
            sum=total)
    return figures


def method_figures(scene: Any, medium: Any, sizes: Sizes) -> Figures:
    """Return the seconds of one picture by each method, tables made anew, their ratios, and the errors."""
    columns, rows = sizes.field_lights
    lit = scenes.under_sky(sizes.field_image, columns, rows)
    work: dict[str, Callable[[], Any]] = {
        name: partial(mi.render, lit, spp=1, integrator=one_image.integrator(columns, rows, visibility=name,
                                                                             map_memory=MEMORY)) for name in METHODS}
    times = rounds(work, min(sizes.repeats, 3))
    dr.flush_malloc_cache()  # the volume's gigabytes
    picture, table = Picture(scene, medium, sizes.error_image), table_of(spheres.fibonacci(columns * rows))
    truth = picture.image(table, building.build("raymarch", medium, table, building.Options(FINE)))
    options = building.Options(2 / SAMPLES)
    subject = f"picture of {sizes.field_image}² pixels, {columns * rows} lights, tables made anew"
    figures: Figures = {}
    for name in METHODS:
        error = relative_rmse(picture.image(table, building.build(name, medium, table, options)), truth)
        figures[f"method_{name}"] = figure(f"{subject}, {name}", "s", times[name])
        figures[f"method_error_{name}"] = figure(f"{columns * rows} lights, {name}, relative RMSE to a fine march on "
                                                 "the same points", "%", [100 * error])
        for other in ("raymarch", "transmittance_volume"):
            if name not in ("raymarch", other):
                figures[f"method_{other}_over_{name}"] = {"title": f"{subject}, {other} over {name}", "unit": "×",
                                                          **record.ratio(times[other], times[name])}
    return figures


def setting_figures(medium: Any, sizes: Sizes) -> Figures:
    """Return the time of a point and light, at points that a camera sees, by the representation of the field.

    Marches skip empty space in all of them. The making of tables is not included; it is ``making_seconds``.
    """
    grid, network = medium.field.grid, medium.field.network
    paper = networks.random_network(sizes.hidden)
    settings = {
        "voxels": (_like(medium, grid, network), sizes.setting_points[0], "voxels"),
        "shipped": (_like(medium, NetworkVolume(network, grid, grid.majorant), network), sizes.setting_points[1],
                    "the shipped networks"),
        "paper": (_like(medium, networks.PaperField(grid, paper), paper), max(1, sizes.setting_points[1] // 8),
                  "networks of the paper's size"),
    }
    table = table_of(spheres.fibonacci(sizes.slow_lights))
    figures: Figures = {}
    for key, (field, count, words) in settings.items():
        x, making = _seen(medium, count), {}
        work: dict[str, Callable[[], Any]] = {}
        names = ["raymarch", "ray_network"]
        if key != "paper":  # its map would take millions of queries, and a lookup costs the same as the others
            names += ["neural_transmittance", "transmittance_map"]
        for name in names:
            start = time.perf_counter()
            built = building.build(name, field, table, building.Options(2 / SAMPLES, sizes.map))
            dr.sync_thread()
            making[name] = time.perf_counter() - start
            work[name] = partial(timing.look_up, built, table, x)
        for name, values in rounds(work, min(sizes.repeats, 3)).items():
            each = [1e9 * v / (dr.width(x) * table.count) for v in values]
            figures[f"setting_{key}_{name}"] = figure(f"field of {words}, {name}, per point and light", "ns", each,
                                                      making_seconds=making[name])
    return figures


def _like(medium: Any, source: Any, network: Any) -> Any:
    """Return a stand-in for `medium` with the density of `source`, for visibility methods."""
    field = SimpleNamespace(grid=medium.field.grid, network=network, softness=medium.field.softness, trained=True)
    return SimpleNamespace(field=field, source=source)


def _seen(medium: Any, count: int) -> Any:
    """Return `count` neighbouring points where parallel camera rays meet the voxels."""
    x = timing.seen_points(medium).x
    first = (dr.width(x) - count) // 2
    part = tuple(dr.gather(mi.Float, c, first + dr.arange(mi.UInt32, count)) for c in x)
    dr.eval(part)
    return part


def camera_light_figures(sizes: Sizes) -> Figures:
    """Return the speed-up of a point light at the camera over the same light beside it, which needs a method."""
    def at(distance: float) -> Any:
        return scenes.statue(sizes.image, lambda camera: {
            "type": "point", "position": list(camera * (1 + distance)), "intensity": 30.0})

    beside = at(0.02)
    work: dict[str, Callable[[], Any]] = {}
    for name, scene, method in (("camera", at(0), "raymarch"), ("march", beside, "raymarch"),
                                ("map", beside, "transmittance_map")):
        nrf = mi.load_dict({"type": "nrf", "visibility": method, "samples": SAMPLES})
        work[name] = partial(mi.render, scene, integrator=nrf, spp=1)
    times = rounds(work, sizes.repeats)
    words = {"march": "a march for each point", "map": "a map"}
    return {f"camera_light_over_{name}": {
        "title": f"picture of {sizes.image}² pixels, a light at the camera, speed-up over {words[name]}", "unit": "×",
        **record.ratio(times[name], times["camera"])} for name in words}


def scaling_figures(sizes: Sizes) -> Figures:
    """Return the seconds of a picture by maps under 1 to 500 lights, and the line through their medians."""
    counts = [columns * rows for columns, rows in sizes.skies]
    times = [one_image.timed(scenes.under_sky(sizes.image, *sky), one_image.integrator(*sky), min(sizes.repeats, 3))
             for sky in sizes.skies]
    medians = np.median(times, 1)
    slope, intercept = np.polyfit(counts, medians, 1)
    residual = float(np.abs(medians - slope * np.array(counts) - intercept).max() / medians.max())
    picture = f"picture of {sizes.image}² pixels, transmittance_map"
    return {"picture_500": figure(f"{picture}, {counts[-1]} lights", "s", times[-1]),
            "per_light": figure(f"{picture}, time per light, {counts[0]} to {counts[-1]} lights", "ms", [1e3 * slope],
                                lights=counts, seconds=medians.tolist(), intercept_seconds=float(intercept),
                                worst_residual=residual)}


def first_figures(sizes: Sizes) -> Figures:
    """Return the seconds of a process's first picture: without kernels and maps of earlier processes, and with them."""
    columns, rows = sizes.skies[-1]
    subject = f"first picture of a process, {sizes.image}² pixels, transmittance_map, {columns * rows} lights"
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as home:
        for key, words in (("cold", "nothing in the caches"), ("warm", "kernels and maps in the caches")):
            result = one_image.run(sizes.image, columns, rows, 1, Path(home))
            figures[f"first_{key}"] = figure(f"{subject}, {words}", "s", result["seconds"],
                                             process_seconds=result["process_seconds"])
    return figures


def many_figures(sizes: Sizes) -> Figures:
    """Return time and peak memory of a picture under the large environment, in a process of its own."""
    columns, rows = sizes.many
    result = one_image.run(sizes.image, columns, rows, 1)
    subject = f"picture of {sizes.image}² pixels, transmittance_map, {columns} × {rows} lights"
    return {"picture_many": figure(subject, "s", result["seconds"]),
            "memory_many": figure(f"{subject}, peak memory", "GiB", [result["peak_bytes"] / 2**30])}


def draw(figures: Figures, path: Path) -> None:
    """Write the curves of time and speed-up over the number of lights as PNG (the paper's speed-up figure)."""
    from matplotlib.figure import Figure

    sheet = Figure(figsize=(10, 4.8), layout="constrained")
    left, right = sheet.subplots(1, 2)
    line = figures["per_light"]
    counts, medians = np.array(line["lights"]), np.array(line["seconds"])
    ends = np.array([0, counts.max()])
    left.plot(ends, line["intercept_seconds"] + 1e-3 * line["median"] * ends, color="0.6", label="linear fit")
    left.plot(counts, medians, "o", label="measured")
    left.set(xlabel="lights", ylabel="seconds", ylim=(0, None), title="whole picture, shipped field, transmittance_map")
    left.legend()
    lights = np.unique(np.geomspace(1, LIGHTS, 60).astype(int))
    rows = figures["costs"]["rounds"]
    for table, culled, words in networks.CASES.values():
        by_map, by_volume = np.median([networks.whole(costs, lights, table, culled) for costs in rows], 0)
        right.plot(lights, by_volume / by_map, label=words)
    right.axhline(92.2, color="0.6", linestyle=":", label="the paper: 92 at 500 lights")
    right.set(xlabel="lights", yscale="log", ylabel="times faster", title="whole picture, volume over map (composed)")
    sheet.legend(*right.get_legend_handles_labels(), loc="outside lower right", fontsize=7, ncols=2)
    with files.replacing(path) as temporary:
        sheet.savefig(temporary, format="png", dpi=110)


def main() -> None:
    """Measure, write the results and draw the figure."""
    options = record.options(__doc__)
    record.prepare()
    start = time.perf_counter()
    figures = measure(QUICK if options.quick else FULL,
                      lambda text: print(f"{time.perf_counter() - start:5.0f} s  {text}", file=sys.stderr))
    record.write("speed", figures, start, options.out)
    draw(figures, options.out / "speed.png")
    print(f"load {os.getloadavg()[0]:.2f} at the end")


if __name__ == "__main__":
    main()
