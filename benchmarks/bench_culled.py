"""Rows of the paper's comparison, composed of the costs of :mod:`benchmarks.bench_paper`: volume over map.

Unculled on both sides, as in the paper: every ray of every table is asked of, all its samples; every sample of a camera
ray is asked of and shaded. Culled on both sides: neither asks in empty space nor where τ has passed e^−12; a volume
skips samples, a map whole rays. What says where space is empty is voxels, baked from the paper's field once, on both
sides. Our network reads a culled march: its ray costs as much in either row, and it pays for the voxels in both.
"""

from typing import Any

from . import bench_paper
from .bench_measure import Row, Sizes, row
from .bench_paper import IMAGE_SAMPLES, LIGHTS, SIDE, STAGE_SAMPLES

Costs = dict[str, float]
UNCULLED, CULLED = "unculled on both sides", "culled on both sides"


def table_seconds(costs: Costs, table: str, culled: bool) -> float:
    """Seconds a ray of a light's table: ``volume/256``, ``volume/192``, ``map`` or ``ours``. Ours: no ray is left out,
    as none is in its measurement."""
    if not culled or table == "ours":
        return costs[table]
    return costs[table] * costs["share/rays" if table == "map" else table.replace("volume", "share")]


def stage_rows(costs: Costs, sizes: Sizes) -> list[Row]:
    """The transmittance stage: 500 directional lights, 64 + 192 samples a ray, m = 600² on both sides."""
    rays = max(1, sizes.queries // STAGE_SAMPLES)
    m, volume = max(sizes.paper_maps), f"volume/{STAGE_SAMPLES}"
    found = []
    for how, table, culled, least in (
        (UNCULLED + ", paper's network", "map", False, 230),
        (CULLED + ", paper's network", "map", True, None),
        ("unculled volume, our network, which reads a culled march", "ours", False, 1000),
        (CULLED + ", our network", "ours", True, None),
    ):
        slow, fast = (LIGHTS * m**2 * table_seconds(costs, name, culled) for name in (volume, table))
        slow, fast = slow + culled * costs["voxels"], fast + (culled or table == "ours") * costs["voxels"]
        found.append(row(f"transmittance stage, {LIGHTS} lights, m = {m}², volume over map, {how}", slow / fast, "×",
                         least=least, weights=_weights(table),
                         extrapolated=f"volume: {sizes.slow_lights} lights, {rays} rays in all",
                         details={"volume_seconds": slow, "map_seconds": fast, "costs": costs}))
    return found


def lookup(costs: Costs, table: str) -> float:
    """Seconds to look up and to shade a point and light."""
    return costs["shade/volume" if table.startswith("volume") else "shade/map"]


def image_rows(costs: Costs, sizes: Sizes) -> list[Row]:
    """The whole 600 × 600 picture under 500 lights, 192 samples, each map resolution."""
    found = []
    for m in sizes.paper_maps:
        most = m == max(sizes.paper_maps)
        for how, table, culled, least in (
            (UNCULLED + ", paper's network", "map", False, 92 if most else None),
            (CULLED + ", paper's network", "map", True, None),
            ("unculled volume, our network, which reads a culled march", "ours", False, 192 if most else None),
            (CULLED + ", our network", "ours", True, None),
        ):
            # Beside our network's culled march, camera rays are culled on both sides.
            seen = culled or table == "ours"
            camera = SIDE**2 * (costs["camera"] if seen else IMAGE_SAMPLES * costs["query"])
            slow_fixed, fast_fixed = camera + culled * costs["voxels"], camera + seen * costs["voxels"]
            slow_light, fast_light = (
                SIDE**2 * (costs["points"] if seen else IMAGE_SAMPLES) * lookup(costs, name)
                + m * m * table_seconds(costs, name, culled) for name in (f"volume/{IMAGE_SAMPLES}", table))
            slow, fast = slow_fixed + LIGHTS * slow_light, fast_fixed + LIGHTS * fast_light
            details: dict[str, Any] = {
                "volume_seconds": slow, "map_seconds": fast, "volume_fixed_seconds": slow_fixed,
                "map_fixed_seconds": fast_fixed, "volume_lights_seconds": slow_light,
                "map_lights_seconds": fast_light}
            found.append(row(
                f"whole {SIDE}² image, {LIGHTS} lights, m = {m}², volume over map, {how}", slow / fast, "×",
                least=least, weights=_weights(table), details=details,
                extrapolated=f"tables: {sizes.slow_lights} lights; {sizes.pixels}² pixels; shading under "
                             f"{sizes.tables[0]} lights"))
    return found


def share_rows(costs: Costs) -> list[Row]:
    """What culling leaves."""
    what = f"what culling leaves of rays of {LIGHTS} lights, "
    return [row(f"{what}queries, {n} a ray", 100 * costs[f"share/{n}"], "%") for n in (STAGE_SAMPLES, IMAGE_SAMPLES)
            ] + [row(what + "rays of a map", 100 * costs["share/rays"], "%")]


def rows(scene, medium, sizes: Sizes) -> list[Row]:
    """All rows of this file."""
    costs = bench_paper.costs_of(scene, medium, sizes)
    return stage_rows(costs, sizes) + image_rows(costs, sizes) + share_rows(costs)


def _weights(table: str) -> str:
    return "field, network: random" if table == "map" else "field: random; network: trained"
