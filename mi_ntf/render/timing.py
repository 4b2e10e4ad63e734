"""Seconds of renders by the clock: what is built, what grows with the picture, and what compiles kernels."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypedDict, TypeVar

import drjit as dr
import mitsuba as mi

T = TypeVar("T")


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
"""Seconds of the work that :func:`measure` runs; None if nothing is measured, and inside of :func:`building`."""


def measure(work: Callable[[], T]) -> tuple[T, Seconds]:
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


def _compilation(kernel: dict[str, float]) -> float:
    return 1e-3 * (kernel.get("codegen_time", 0) + kernel.get("backend_time", 0))


class RenderCost(TypedDict):
    """Cost of a render: seconds in all, those that compiled kernels or built tables, and the most memory of Dr.Jit."""

    wall_seconds: float
    compile_seconds: float
    build_seconds: float
    peak_bytes: int


def once(scene: "mi.Scene", integrator: "mi.Integrator", spp: int, seed: int) -> tuple["mi.TensorXf", RenderCost]:
    """Render `scene` by any integrator; return the image and its cost."""
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()
    begin = time.perf_counter()

    def work() -> "mi.TensorXf":
        image = mi.render(scene, integrator=integrator, seed=mi.UInt32(seed), spp=spp)
        dr.eval(image)
        dr.sync_thread()
        return image

    image, seconds = measure(work)
    return image, {"wall_seconds": time.perf_counter() - begin, "compile_seconds": seconds.compiling,
                   "build_seconds": seconds.building,
                   "peak_bytes": int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))}
