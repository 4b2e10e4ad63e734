"""Predicted cost of the stages of a render, from a few constants of the machine, and the choice of the cheapest method.

Constants are measured by :mod:`mi_ntf.render.commands.calibration`, which `mi-ntf explain --measure` and `mi-ntf
bench` run; a render reads them from the user's cache, or takes those of two cores of 2024.
"""

import ctypes
import hashlib
import json
import platform
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import __version__
from ...core import radiosity
from ...infer import march
from ...infer.visibility import REGISTRY
from ...infer.visibility.method import resolution_for
from .. import user_cache

CACHE = "cost.json"
"""Where constants are kept, in the user's cache."""
PROGRAM = Path(__file__).parents[1] / "commands" / "calibration.py"
"""What measures them."""

ALIKE = 1.2
"""Ratio of predicted seconds up to which two methods count as equally fast."""
FACING = 0.5
"""Share of (point, light) pairs whose light falls on the front, the others ask for no visibility."""
COVERAGE = 0.35
"""Share of the camera rays that hit the object."""
POINTS_A_HIT = 6.5
"""Shading points of a camera ray that hits, from 384 samples across the diameter on (5.7 to 7.1 on four objects); of
fewer samples 0.6 of it at 96."""
POINTS_IN_SMOKE = 33.0
"""The same in smoke (`cloud`)."""
FACES = 1.85
"""Patches in a cell that holds some of a skin: one for each axis that its normals are nearest to (1.7 to 2.1 on four
objects)."""
NOT_SKIPPED = 0.05
"""Share of the samples across the diameter at which a camera ray's march asks the field."""


_OWN = {"camera": 0.5, "reflect": 40.0, "shade": 2.0, "between": 1000.0, "density": 60.0}
_PRICES = _OWN | {name: price for method in REGISTRY.values() for name, price in method.prices.items()}
Constants: Any = make_dataclass(
    "Constants", [(name, float, field(default=price)) for name, price in _PRICES.items()], frozen=True)
"""Nanoseconds on all cores together.

camera    a camera ray, per sample that would lie across the unit sphere's diameter (most are skipped)
reflect   reflectance at a shading point
shade     a point and light, its visibility left out
between   a ray between patches of the skin
density   a query of the density network
…         what each visibility method counts in (:attr:`mi_ntf.infer.visibility.method.Method.prices`)
"""


@dataclass(frozen=True)
class Work:
    """The size of a render.

    rays, points  camera rays, shading points
    lights        of the table
    drawn         lights drawn at random for each point
    others        rays towards lights from surfaces and further bounces, which no light's own map serves
    texels        of a map: m²; `components`: logistics in each
    samples       cells across the unit sphere's diameter
    source        of maps: ``field`` or ``network``
    network       the field is its networks, not its grid; `held`: bytes of the grid
    opaque        the field is no smoke
    patches       that light bounces between, 0 where it does not by radiosity
    frames        pictures that share what is built for a field; `still`: and for each light
    """

    rays: float
    points: float
    lights: int
    method: str
    texels: int
    samples: int
    source: str = "field"
    components: int = 1
    network: bool = False
    held: int = 0
    opaque: bool = True
    patches: int = 0
    drawn: int = 0
    others: float = 0.0
    frames: int = 1
    still: bool = False


def per_pair(work: Work, c: Constants) -> float:
    """ns of one point and light by the method that `work` names, once it is built."""
    return REGISTRY[work.method].pair(work, c)


def per_drawn_pair(work: Work, c: Constants) -> float:
    """Return ns of one point and a light that is drawn at random."""
    return REGISTRY[REGISTRY[work.method].for_drawn].pair(work, c)


def making(work: Work, c: Constants) -> float:
    """ns that the method takes to be built."""
    method = REGISTRY[work.method]
    return method.making(work, c) * (1 if method.per_field else work.lights) if method.making else 0.0


def shared(work: Work, c: Constants) -> float:
    """ns of :func:`making` that fall on one of `work.frames` pictures."""
    return making(work, c) / (work.frames if work.still or REGISTRY[work.method].per_field else 1)


def asking(work: Work, c: Constants) -> float:
    """ns of every light's τ at every point that faces it."""
    random = (work.points * work.drawn + work.others) * per_drawn_pair(work, c)
    return FACING * (work.points * work.lights * per_pair(work, c) + random)


def visibility(work: Work, c: Constants) -> float:
    """ns of all that depends on the method."""
    return shared(work, c) + asking(work, c)


def choose(work: Work, c: Constants | None = None) -> tuple[str, str]:
    """Return the method of ``visibility=auto``, and why: the least biased of those whose predicted seconds
    (:func:`visibility`) are within ``ALIKE`` of the least. ``work.method`` is not read."""
    prices = c or constants()
    found = {}
    for name, method in REGISTRY.items():
        if method.automatic and (work.lights or not method.drawn):
            found[name] = 1e-9 * visibility(replace(work, method=name), prices)
    best = sorted(found, key=lambda name: found[name])
    lights = " and ".join(f"{n} {kind}" for n, kind in (
        (work.lights, "lights"), (work.drawn, "drawn ones")) if n) or "no light"
    costs = ", ".join(f"{found[name]:.2g} s by {name}" for name in best)
    alike = [name for name in best if found[name] <= ALIKE * found[best[0]]]
    reason = f"about {work.points:.2g} shading points with {lights}: {costs}"
    return min(alike, key=lambda name: REGISTRY[name].automatic), reason


def work(integrator, medium, method: str, rays: int, lights: int = 1, drawn: int = 0, others: float = 0.0) -> Work:
    """Return the work of an ``nrf`` integrator that traces `rays` camera rays through `medium`.

    `lights`: lights of the table; `drawn`: lights drawn at each point; `others`: rays towards lights from elsewhere.
    The number of shading points is a guess, that of an object which fills much of the picture.
    """
    network, opaque = integrator.map_source == "network", medium.field.softness.opaque
    points = rays * COVERAGE * (POINTS_A_HIT if opaque else POINTS_IN_SMOKE) * min(integrator.samples / 384, 1) ** 0.35
    texels = (integrator.map_resolution or resolution_for(lights, medium.field.grid.resolution)) ** 2
    return Work(
        rays=rays, points=points, lights=lights, method=method,
        texels=texels, samples=integrator.samples, source=integrator.map_source,
        components=medium.field.network.components if network else integrator.map_components,
        network=medium.representation == "network", held=medium.field.grid.nbytes, drawn=drawn, others=others,
        opaque=opaque, frames=integrator.frames,
    )


def patches(grid) -> int:
    """Return about how many patches (:class:`mi_ntf.render.transport.bounced.Patches`) the skin in `grid` has, by the
    bricks between matter and empty space."""
    distances = grid.bricks.distances()
    matter = np.pad(distances == 0, 1)
    inner = matter.copy()
    for axis in range(3):
        inner &= np.roll(matter, 1, axis) & np.roll(matter, -1, axis)
    return int(FACES * (matter.sum() - inner.sum()) * (radiosity.CELLS / len(distances)) ** 2)


def seconds(work: Work, c: Constants) -> dict[str, float]:
    """Predicted wall seconds of each stage, compilation left out; ``bounces`` where they are by radiosity."""
    query = c.density if work.network else 0
    pairs = work.points * (work.lights + work.drawn) + work.others
    stages = {
        "maps or volumes": 1e-9 * making(work, c),
        "camera march": 1e-9 * work.rays * work.samples * (c.camera + NOT_SKIPPED * query),
        "reflectance": 1e-9 * work.points * (c.reflect + query),
        "lights": 1e-9 * (pairs * c.shade + asking(work, c)),
    }
    if work.patches:
        rays = radiosity.CHORDS + work.patches * (radiosity.FEW**2 + radiosity.SIDE**2)
        ray = c.between + radiosity.STEPS * NOT_SKIPPED * query
        lit = c.shade + FACING * per_drawn_pair(work, c)
        stages["bounces"] = 1e-9 * (rays * ray + work.patches * work.lights * lit)
    return stages


def memory(work: Work, chunk: int) -> dict[str, int]:
    """Bytes held at a time beside maps, `chunk` camera rays in flight."""
    # Chunks are strips of pixels: those across the object hold more points than others.
    share = work.points / max(work.rays, 1) * (2 if work.rays > chunk else 1)
    camera, between = min(chunk, work.rays), work.patches * radiosity.SIDE**2
    return {
        "field grid": work.held,
        # Some 24 floats a shading point, 12 a ray between patches, in arrays that Dr.Jit rounds up to powers of two;
        # and two for each point that a camera ray may have.
        "rays in flight": round(max(camera * (max(share, 1) * 128 + 8 / march.share(work.opaque)), between * 72)),
    }


def machine() -> str:
    """Return what the constants hold for: version, variant, and processor with its threads or graphics card."""
    variant = str(mi.variant())
    hardware = graphics_card() if variant.startswith("cuda") else f"{processor()} · {dr.thread_count()} threads"
    return f"{__version__} · {hardware} · {variant}"


def graphics_card() -> str:
    """The name of the CUDA device that Dr.Jit computes on, the first that the driver shows; neutral where none is."""
    name = ctypes.create_string_buffer(256)
    device = ctypes.c_int()
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        found = (driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0)
                 or driver.cuDeviceGetName(name, len(name), device)) == 0
    except (OSError, AttributeError):  # no driver, or no such function in it
        found = False
    return name.value.decode(errors="replace").strip() if found and name.value else "CUDA device"


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def constants() -> Constants:
    """This machine's, as measured; the defaults where nothing was measured or the cache cannot be read."""
    return measured() or Constants()


def measured() -> Constants | None:
    """This machine's constants, None where they are not in the cache."""
    found = _read().get(_name())
    if not isinstance(found, dict) or {f.name for f in fields(Constants)} != set(found):
        return None
    prices = all(type(v) in (int, float) and 0 < v < 1e12 for v in found.values())  # up to minutes
    return Constants(**found) if prices else None


def remember(found: Constants) -> None:
    """Keep `found` for this machine. A cache that cannot be written is no fault of the caller's work."""
    user_cache.write_text(CACHE, json.dumps(_read() | {_name(): asdict(found)}, indent=1))


def _name() -> str:
    """Return the key of the constants in the cache: none outlives a change of the program that measures them."""
    return f"{machine()} · {hashlib.sha256(PROGRAM.read_bytes()).hexdigest()[:8]}"


def _read() -> dict:
    try:
        found = json.loads(user_cache.read_text(CACHE) or "{}")
    except (ValueError, RecursionError):  # no JSON, no text, or nested without end
        return {}
    return found if isinstance(found, dict) else {}
