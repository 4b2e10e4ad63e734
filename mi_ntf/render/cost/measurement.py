"""One render, watched: the seconds that its stages really take, told apart by the loops in their kernels; by the clock
where NumPy works beside kernels."""

import os
import time
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

LOOPS = {"camera march": "camera march", "lights": "lights", "free flight": "bounces"}
"""Label of a kernel's loop → stage. Kernels of none of them: before the first camera march they make maps, after one
they fetch reflectance, or are small."""


_watched: list[dict] | None = None
"""History of the render that is watched, as far as it was asked for; None where none is watched."""


@contextmanager
def by_clock(stage: str):
    """All that happens within is `stage`, whatever its kernels; costs nothing where no render is watched."""
    if _watched is None:
        yield
        return
    dr.sync_thread()
    _watched.extend(dr.kernel_history())
    start = time.perf_counter()
    yield
    dr.sync_thread()
    _watched.append({"stage": stage, "execution_time": 1e3 * (time.perf_counter() - start)})
    dr.kernel_history_clear()


@contextmanager
def _watching():
    """Within, a render is watched: its history."""
    global _watched
    _watched = []
    try:
        dr.kernel_history_clear()
        yield _watched
    finally:
        _watched = None


@contextmanager
def maps_made_anew():
    """Within, no transmittance map is taken from a cache (:mod:`mi_ntf.render.maps.map_cache`): what it costs is the
    question."""
    name = "MI_NTF_MAP_CACHE"
    before = os.environ.get(name)
    os.environ[name] = "off"
    try:
        yield
    finally:
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


def measure(scene, integrator, spp: int) -> dict:
    """Render `scene` twice and report the second time, when every kernel is compiled. Maps and patches are made anew.

    ``stages``: kernel seconds, as in :func:`mi_ntf.render.cost.model.seconds`, and those by the clock of ``bounces`` by
    radiosity; ``wall_seconds`` of the whole, Python and the film included; ``points``: shading points; ``peak_bytes``:
    most memory that Dr.Jit held.
    """
    seeds: tuple[Any, Any] = 1, 0  # numbers, where Mitsuba's stub asks for arrays
    with maps_made_anew(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.eval(mi.render(scene, integrator=integrator, seed=seeds[0], spp=spp))
        integrator.patches = None
        dr.sync_thread()
        dr.detail.malloc_clear_statistics()
        with _watching() as history:
            start = time.perf_counter()
            dr.eval(mi.render(scene, integrator=integrator, seed=seeds[1], spp=spp))
            dr.sync_thread()
            wall = time.perf_counter() - start
            history.extend(dr.kernel_history())
    backend = dr.backend_v(mi.Float)
    return by_stage(history) | {"wall_seconds": wall, "peak_bytes": int(dr.detail.malloc_watermark(backend))}


def by_stage(history: list[dict]) -> dict:
    """``stages`` and ``points`` of a kernel history; what :func:`by_clock` put there has its ``stage``."""
    stages = dict.fromkeys(("maps or volumes", "camera march", "reflectance", "lights"), 0.0)
    points, marched = 0, False
    for kernel in history:
        text = kernel["ir"].getvalue() if kernel.get("ir") is not None else ""
        loop = next((s for label, s in LOOPS.items() if f"Symbolic loop: {label}\n" in text), None)
        marched |= loop == "camera march"
        stage = kernel.get("stage") or loop or ("reflectance" if marched else "maps or volumes")
        stages[stage] = stages.get(stage, 0.0) + 1e-3 * kernel["execution_time"]
        points += kernel["size"] if stage == "lights" else 0
    return {"stages": stages, "points": points}
