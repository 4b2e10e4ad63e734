"""What ``mi-ntf bench`` measures: how much of it, and the rows of its report."""

from dataclasses import dataclass, field
from typing import Any

from mi_ntf.core.architecture import PAPER


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    hidden          widths of the networks' layers, the paper's
    queries         network queries a kernel
    repeats         timed runs after one warm-up
    slow_lights     lights that stand for all 500 where those would take hours
    pixels, image   side of the image that stands for 600², and of images rendered whole
    lights, many    environments, columns × rows: from 1 light to the paper's 500; the large one
    paper_maps      texels along a map's side: one for each of the paper's pixels, and ours
    map             ours, where maps are built
    tables          lights, and texels along the side of volume and map, where the shading under all lights is measured:
                    tables that no cache holds (full size: 2.2 and 0.24 GiB)
    error_…         the image, the lights and the map whose error is measured
    single_lights   of which each one's own error is measured
    field_…         the image that every method renders, the environment that lights it
    atlas           texels along the side of an atlas's maps; None: its own
    setting_points  shading points of the loops over a field of voxels, and of networks
    """

    hidden: tuple[int, ...]
    queries: int
    repeats: int
    slow_lights: int
    pixels: int
    image: int
    lights: tuple[tuple[int, int], ...]
    many: tuple[int, int]
    paper_maps: tuple[int, int]
    map: int
    tables: tuple[int, int, int]
    error_image: int
    error_lights: int
    error_map: int
    single_lights: int
    field_image: int
    field_lights: tuple[int, int]
    setting_points: tuple[int, int]
    atlas: int | None


FULL = Sizes(hidden=PAPER.density.hidden, queries=1 << 17, repeats=5, slow_lights=5, pixels=150, image=600,
             lights=((1, 1), (10, 5), (20, 5), (25, 10), (50, 10)), many=(128, 64), paper_maps=(600, 128), map=128,
             tables=(500, 64, 256), error_image=128, error_lights=50, error_map=256, single_lights=12, field_image=200,
             field_lights=(10, 5), setting_points=(1 << 14, 1 << 11), atlas=None)
QUICK = Sizes(hidden=(16,), queries=1 << 10, repeats=1, slow_lights=5, pixels=12, image=16,
              lights=((1, 1), (4, 2), (5, 4)), many=(6, 4), paper_maps=(600, 128), map=16,
              tables=(20, 8, 16), error_image=12, error_lights=2, error_map=16, single_lights=2, field_image=12,
              field_lights=(2, 1), setting_points=(1 << 8, 1 << 5), atlas=4)
"""Runs every line of the benchmark within seconds; its figures mean nothing."""


@dataclass(frozen=True)
class Row:
    """One line of the report.

    asked         the figure to reach, in words; empty: for information
    weights       ``trained`` or ``random``, per network that takes part
    extrapolated  from what; empty: measured whole
    met           whether `measured` reaches it; None where nothing is asked
    details       the numbers that `measured` comes from
    """

    what: str
    measured: float
    unit: str
    asked: str = ""
    weights: str = "trained"
    extrapolated: str = ""
    met: bool | None = None
    details: dict[str, Any] = field(default_factory=dict)


def row(what: str, measured: float, unit: str, *, least: float | None = None, most: float | None = None,
        **rest: Any) -> Row:
    """A row with a bound: `least` or `most`, of the same unit as `measured`."""
    if least is not None:
        return Row(what, measured, unit, f"≥ {least:g} {unit}", met=measured >= least, **rest)
    if most is not None:
        return Row(what, measured, unit, f"≤ {most:g} {unit}", met=measured <= most, **rest)
    return Row(what, measured, unit, **rest)
