"""Mitsuba's variants that the plugins run in, and the threads that it needs. This module imports no renderer."""

from types import ModuleType

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb")
"""Variants with linear RGB, vectorised, with derivatives. The default is the first one that this machine can run, as in
the stock program."""
LEAST_THREADS = 2
"""Minimum number of Dr.Jit's threads. With one thread, Dr.Jit's default on one core, Mitsuba waits for ever when it
reads or writes an EXR file."""


def enough_threads(dr: ModuleType) -> None:
    """Give Dr.Jit, the module `dr`, at least ``LEAST_THREADS`` threads."""
    if dr.thread_count() < LEAST_THREADS:
        dr.set_thread_count(LEAST_THREADS)
