"""Mitsuba's variants that the plugins run in, and the threads that it needs. No renderer is imported here."""

from typing import Any

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb")
"""Linear RGB, vectorised, with derivatives. Where none is chosen, the first of them that this machine can run, as in
the stock program."""
LEAST_THREADS = 2
"""Threads of Dr.Jit. With a single one, its choice where there is one core, Mitsuba waits for ever when it reads or
writes an EXR file."""


def enough_threads(dr: Any) -> None:
    """Give Dr.Jit, the module `dr`, as many threads as Mitsuba needs; more than that stay."""
    if dr.thread_count() < LEAST_THREADS:
        dr.set_thread_count(LEAST_THREADS)
