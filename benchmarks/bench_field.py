"""Every method on one field: whole images of the shipped voxels, and what a point and light cost where the field is
voxels and where it is networks."""

import time
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_ntf.core import spheres
from mi_ntf.evaluate import metrics
from mi_ntf.infer.grid import NetworkVolume
from mi_ntf.render.maps import building

from . import bench_image, bench_paper, loops
from .bench_lights import FINE, Picture
from .bench_measure import Row, Sizes, row
from .loops import seconds, table_of

METHODS = ("raymarch", "transmittance_volume", "transmittance_map", "transmittance_atlas", "neural_transmittance",
           "ray_network")
MEMORY = 4096.0
"""MiB: each method in one part."""


def same_field_rows(scene, medium, sizes: Sizes) -> list[Row]:
    """Return a row for each method: seconds of one image, its speed over the march and over the volume, its error to a
    fine march. Tables, maps and atlas are made anew for the image."""
    columns, rows = sizes.field_lights
    lit = bench_image.under_sky(sizes.field_image, columns, rows)
    work: dict[str, Callable[[], Any]] = {
        name: partial(mi.render, lit, spp=1, integrator=bench_image.integrator(
            columns, rows, visibility=name, map_memory=MEMORY)) for name in METHODS}
    found = seconds(work, min(sizes.repeats, 3))
    dr.flush_malloc_cache()  # the volume's gigabytes
    errors = _errors(scene, medium, sizes)
    what = f"the same field, whole image, {sizes.field_image}², {columns * rows} lights, tables made anew, "
    result = []
    for name, value in found.items():
        details = {"over_raymarch": found["raymarch"] / value, "over_volume": found["transmittance_volume"] / value,
                   "error_percent": errors[name], "samples": bench_image.SAMPLES}
        result.append(row(what + name, value, "s", details=details))
    for other in ("raymarch", "transmittance_volume"):
        result += [row(f"the same field, whole image, {other} over {name}", found[other] / value, "×")
                   for name, value in found.items() if name not in ("raymarch", other)]
    return result + [row(f"the same field, {columns * rows} lights, {name}, relative RMSE to a fine march, same points",
                         error, "%") for name, error in errors.items()]


def _errors(scene, medium, sizes: Sizes) -> dict[str, float]:
    """Relative RMSE, percent, to a march of steps of 1/768, on the shading points of one camera march."""
    picture = Picture(scene, medium, sizes.error_image)
    columns, rows = sizes.field_lights
    table = table_of(spheres.fibonacci(columns * rows))
    truth = picture.image(table, building.build("raymarch", medium, table, building.Options(FINE)))
    options = building.Options(2 / bench_image.SAMPLES)  # of integrators by default
    return {m: 100 * metrics.relative_rmse(picture.image(table, building.build(m, medium, table, options)), truth)
            for m in METHODS}


def setting_rows(medium, sizes: Sizes) -> list[Row]:
    """Nanoseconds of a point and light, at points that a camera sees: where the field is voxels, where it is the
    shipped networks (``representation`` ``network``), and where it is networks of the paper's size. Marches skip empty
    space in all three. What a method makes first is not in them; it is in the details."""
    grid, network = medium.field.grid, medium.field.network
    paper = bench_paper.random_network(sizes.hidden)
    settings = {
        "field of voxels": (_like(medium, grid, network), sizes.setting_points[0], True),
        "field of the shipped networks": (_like(medium, NetworkVolume(network, grid, grid.majorant), network),
                                          sizes.setting_points[1], True),
        # Its map would ask millions of queries; a lookup costs what it costs above.
        "field of networks of the paper's size": (_like(medium, bench_paper.PaperField(grid, paper), paper),
                                         max(1, sizes.setting_points[1] // 8), False),
    }
    result = []
    for setting, (field, count, tables) in settings.items():
        ns, making = _loops(field, _seen(medium, count), tables, sizes)
        for name, value in ns.items():
            details = {"points": count, "lights": sizes.slow_lights, "making_seconds": making[name],
                       "over_raymarch": ns["raymarch"] / value}
            weights = "field, network: random" if setting.endswith("paper's size") else "trained"
            result.append(row(f"{setting}, {name}, per point and light", value, "ns", weights=weights,
                              details=details))
    return result


def _like(medium, source, network):
    """Return a stand-in for `medium`, for visibility methods, with the density of `source`."""
    field = SimpleNamespace(grid=medium.field.grid, network=network, softness=medium.field.softness)
    return SimpleNamespace(field=field, source=source)


def _loops(medium, x, tables: bool, sizes: Sizes) -> tuple[dict[str, float], dict[str, float]]:
    """``(ns, making)``: ns a point of `x` and light, and seconds to make what a method holds (for `slow_lights` lights;
    an atlas: for all), once, compilation included."""
    table = table_of(spheres.fibonacci(sizes.slow_lights))
    names = ["raymarch", "ray_network"] + ["neural_transmittance", "transmittance_map"] * tables
    work: dict[str, Callable[[], Any]] = {}
    making = {}
    for name in names:
        options = building.Options(2 / bench_image.SAMPLES, sizes.map)
        start = time.perf_counter()
        built = building.build(name, medium, table, options)
        dr.sync_thread()
        making[name] = time.perf_counter() - start
        work[name] = partial(loops.look_up, built, table, x)
    found = seconds(work, min(sizes.repeats, 3))
    return {name: 1e9 * value / (dr.width(x) * table.count) for name, value in found.items()}, making


def _seen(medium, count: int):
    """`count` points, side by side, where parallel camera rays meet the voxels."""
    x = loops.seen_points(medium).x
    first = (dr.width(x) - count) // 2
    part = tuple(dr.gather(mi.Float, c, first + dr.arange(mi.UInt32, count)) for c in x)
    dr.eval(part)
    return part
