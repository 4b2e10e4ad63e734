"""Measured seconds of the stages of a render, told apart by the loops in their kernels, or by the clock where NumPy
works beside kernels."""

import os
import time
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

LOOPS = {"camera march": "camera march", "lights": "lights", "free flight": "bounces"}
"""Label of a kernel's loop → stage. Kernels of none of them: before the first camera march they make maps, after one
they fetch reflectance, or are small."""

BUILT = ("maps or volumes", "bounces")
"""Stages that do not grow with pixels and samples."""

_watched: list[dict] | None = None
"""History of the render that is watched, as far as it was asked for; None where none is watched."""


@contextmanager
def by_clock(stage: str):
    """Attribute the time of the block to `stage`, whatever its kernels; free of cost where no render is measured."""
    if _watched is None:
        yield
        return
    dr.sync_thread()
    _watched.extend(dr.kernel_history())
    start = time.perf_counter()
    yield
    dr.sync_thread()
    compiled = compilation(dr.kernel_history())
    _watched.append({"stage": stage, "execution_time": 1e3 * (time.perf_counter() - start - compiled),
                     "backend_time": 1e3 * compiled})


@contextmanager
def _watching():
    """Within, a render is watched: its history. One within another is the other's stage ``trials``."""
    global _watched
    outer, _watched = _watched, []
    before = dr.kernel_history()
    try:
        yield _watched
    finally:
        if outer is not None:
            outer.extend([*before, *(kernel | {"stage": "trials"} for kernel in _watched)])
        _watched = outer


def watch(work):
    """``(result, stages)``: what `work()` returns, and the seconds of its kernels as in :func:`by_stage`, compilation
    left out. It evaluates what it returns itself. Dr.Jit shares kernels of a hundred entries among all threads."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        with _watching() as history:
            result = work()
            dr.sync_thread()
            history.extend(dr.kernel_history())
    return result, by_stage(history)["stages"]


@contextmanager
def maps_made_anew():
    """Within, no transmittance map is taken from a cache (:mod:`mi_ntf.render.maps.map_cache`): what it costs is the
    question."""
    name = "MI_NTF_CACHE"
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

    What is returned is that of :func:`once`.
    """
    with maps_made_anew():
        once(scene, integrator, spp, 1)
        integrator.patches = None
        return once(scene, integrator, spp, 0)[1]


def once(scene, integrator, spp: int, seed: Any) -> tuple[Any, dict]:
    """Render `scene` by any integrator: the image, and what that took.

    ``stages``: kernel seconds, as in :func:`mi_ntf.render.cost.model.seconds`, those by the clock of ``bounces`` by
    radiosity, and of ``trials`` before a render with limits; ``wall_seconds`` of the whole, Python, compilation and the
    film included; ``compile_seconds`` of it; ``points``: shading points; ``peak_bytes``: most memory that Dr.Jit held.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.detail.malloc_clear_statistics()
        with _watching() as history:
            start = time.perf_counter()
            image = mi.render(scene, integrator=integrator, seed=seed, spp=spp)
            dr.eval(image)
            dr.sync_thread()
            wall = time.perf_counter() - start
            history.extend(dr.kernel_history())
    peak = int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))
    return image, by_stage(history) | {"wall_seconds": wall, "compile_seconds": compilation(history),
                                       "peak_bytes": peak}


def compilation(history: list[dict]) -> float:
    """Seconds of a kernel history that went into making kernels, or into fetching them from Dr.Jit's cache on disk."""
    return 1e-3 * sum(kernel.get("codegen_time", 0) + kernel.get("backend_time", 0) for kernel in history)


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
