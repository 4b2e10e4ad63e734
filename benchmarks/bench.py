"""``mi-ntf bench``: every speed figure of the project, measured in one run.

Medians after a warm-up that compiles; both sides of a ratio alternate within one process. A figure that stands for more
than was run says so. Other work on the machine falsifies seconds, ratios less.
"""

import json
import os
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import mitsuba as mi
from rich.console import Console
from rich.table import Table

from mi_ntf.core import files
from mi_ntf.core.variants import VARIANTS
from mi_ntf.infer.visibility import transmittance_atlas
from mi_ntf.render import register, user_cache
from mi_ntf.render.machine import processor

from . import bench_culled, bench_field, bench_image, bench_lights, bench_product
from .bench_measure import FULL, QUICK, Row, Sizes


def bench(quick: bool = False, out: Path | None = None, say: Callable[[str], None] = lambda text: None) -> dict:
    """Measure everything; return ``{"machine": …, "rows": […]}``, JSON-ready.

    quick  tiny sizes: shows that everything runs
    out    folder for ``bench.json`` and ``bench.png``; None: write nothing
    say    hears what is measured next
    """
    if mi.variant() is None:
        mi.set_variant(*VARIANTS)
    register()
    sizes = QUICK if quick else FULL
    start = time.perf_counter()
    sections = _sections(sizes)
    rows = []
    with user_cache.switched("off"), _atlas(sizes.atlas):
        for title, work in sections.items():
            say(f"{time.perf_counter() - start:5.0f} s  {title}")
            rows += work()
    report = {"machine": machine(), "quick": quick, "seconds": time.perf_counter() - start,
              "rows": [asdict(r) for r in rows]}
    if out is not None:
        from . import bench_figure

        files.make_folder(out)
        files.write(out / "bench.json", json.dumps(report, indent=1) + "\n")
        bench_figure.draw(report, out / "bench.png")
    return report


def _sections(sizes: Sizes) -> dict[str, Callable[[], list[Row]]]:
    scene = bench_image.under_sky(sizes.image)
    medium = bench_image.medium_of(scene)
    return {
        "the paper's networks": lambda: bench_culled.rows(scene, medium, sizes),
        "map lookup": lambda: bench_product.lookup_rows(medium, sizes),
        "error of the maps": lambda: bench_product.error_rows(bench_image.under_sky(sizes.error_image), sizes),
        "error under single lights": lambda: bench_lights.rows(scene, medium, sizes),
        "every method on the same field": lambda: bench_field.same_field_rows(scene, medium, sizes),
        "a field of voxels and a field of networks": lambda: bench_field.setting_rows(medium, sizes),
        "one light at the camera": lambda: bench_product.collocated_rows(sizes),
        "1 to 500 lights": lambda: bench_product.scaling_rows(sizes),
        "first picture": lambda: bench_product.first_rows(sizes),
        "8192 lights": lambda: bench_product.many_lights_rows(sizes),
    }


@contextmanager
def _atlas(resolution: int | None):
    """Within, the maps of an atlas have `resolution`² texels: millions of rays take a second, --quick makes many."""
    before = transmittance_atlas.RESOLUTION
    transmittance_atlas.RESOLUTION = resolution or before
    try:
        yield
    finally:
        transmittance_atlas.RESOLUTION = before


def machine() -> dict:
    """Return the machine, its load and the versions that the figures were measured with."""
    return {"processor": processor(), "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2),
            "variant": mi.variant(), "mitsuba": mi.__version__}


def print_table(report: dict) -> None:
    """The report for a reader."""
    console = Console()
    console = console if console.is_terminal else Console(width=150)
    where = report["machine"]
    console.print(f"{where['processor']}, {where['cores']} cores, load {where['load']} at the end, {where['variant']}; "
                  f"measured in {report['seconds']:.0f} s", highlight=False)
    if report["quick"]:
        console.print("--quick: tiny sizes, figures without meaning", highlight=False)
    table = Table("what", "asked", "measured", "", "networks", "extrapolated from")
    for r in report["rows"]:
        met = {True: "reached", False: "MISSED", None: ""}[r["met"]]
        table.add_row(r["what"], r["asked"], f"{r['measured']:.3g} {r['unit']}", met, r["weights"], r["extrapolated"])
    console.print(table)
