"""Seconds of renders by the clock: what is built, what grows with the picture, and what compiles kernels."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass
class Seconds:
    """Wall-clock seconds of some work.

    building   building of maps, atlases and light between patches, which does not grow with pixels and samples
    kernels    execution of all other kernels
    compiling  compilation of kernels, or their loading from Dr.Jit's cache
    """

    building: float = 0.0
    kernels: float = 0.0
    compiling: float = 0.0

    def add_kernels(self) -> None:
        """Add the kernels that have ended since the last call, in this process."""
        dr.sync_thread()
        for kernel in dr.kernel_history():
            self.kernels += 1e-3 * kernel["execution_time"]
            self.compiling += _compilation(kernel)


_measured: Seconds | None = None
"""Those of the work that :func:`measure` runs; None where nothing is measured, and inside of :func:`building`."""


def measure(work: Callable[[], Any]) -> tuple[Any, Seconds]:
    """Return the result of ``work()``, which has to be evaluated by it, and its seconds.

    Uses Dr.Jit's kernel history, which is empty afterwards. Work that measures a part of itself has the seconds of that
    part as well.
    """
    global _measured
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        (_measured or Seconds()).add_kernels()  # those before the work
        outer, _measured = _measured, Seconds()
        own = _measured
        try:
            result = work()
            own.add_kernels()
        finally:
            _measured = outer
    if outer:
        outer.building += own.building
        outer.kernels += own.kernels
        outer.compiling += own.compiling
    return result, own


@contextmanager
def building() -> Iterator[None]:
    """Count the block as :attr:`Seconds.building`. Costs nothing where no work is measured."""
    global _measured
    seconds = _measured
    if seconds is None:
        yield
        return
    seconds.add_kernels()
    _measured = None
    begin = time.perf_counter()
    try:
        yield
        dr.sync_thread()
        compiling = sum(map(_compilation, dr.kernel_history()))
        seconds.building += time.perf_counter() - begin - compiling
        seconds.compiling += compiling
    finally:
        _measured = seconds


def _compilation(kernel: dict) -> float:
    return 1e-3 * (kernel.get("codegen_time", 0) + kernel.get("backend_time", 0))


def once(scene, integrator, spp: int, seed: Any) -> tuple[Any, dict]:
    """Render `scene` by any integrator.

    Returns the image, and ``wall_seconds`` of all of it, of which ``compile_seconds`` compiled kernels and
    ``build_seconds`` built maps, atlases and light between patches; ``peak_bytes``, most memory that Dr.Jit held.
    """
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()
    begin = time.perf_counter()

    def work():
        image = mi.render(scene, integrator=integrator, seed=seed, spp=spp)
        dr.eval(image)
        dr.sync_thread()
        return image

    image, seconds = measure(work)
    return image, {"wall_seconds": time.perf_counter() - begin, "compile_seconds": seconds.compiling,
                   "build_seconds": seconds.building,
                   "peak_bytes": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))}
