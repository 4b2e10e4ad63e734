"""Dr.Jit's types of one back end. Mitsuba's ``mi.Float`` and friends are these very types."""

import importlib
from types import ModuleType

import numpy as np

from ..core.errors import MiNtfError
from ..core.variants import VARIANTS


def module(variant: str) -> ModuleType:
    """The Dr.Jit module (``Float``, ``Texture2f``, …) behind a Mitsuba variant such as ``llvm_ad_rgb``.

    Raises MiNtfError for variants without a JIT compiler, without derivatives, or not linear RGB in single precision.
    """
    if variant not in VARIANTS:
        raise MiNtfError(
            f"variant {variant}: the nrf and ntf plugins need llvm_ad_rgb or cuda_ad_rgb; "
            "add `-m llvm_ad_rgb` to the command line"
        )
    return importlib.import_module(f"drjit.{variant.partition('_')[0]}.ad")


ALIGNMENT = 64
"""Bytes that Dr.Jit's own arrays begin at a multiple of."""


def floats(values: np.ndarray, dj: ModuleType):
    """`values`, raveled, as a ``Float`` of the module `dj`. Dr.Jit takes NumPy's memory as it lies on a processor, and
    kernels that fetch from it differ by whether it is aligned, which is chance: they were compiled again now and then,
    for a light that moved."""
    return dj.Float(_aligned(values, np.float32))


def words(values: np.ndarray, dj: ModuleType):
    """Return `values`, raveled, as a ``UInt32`` of the module `dj`; see :func:`floats`."""
    return dj.UInt32(_aligned(values, np.uint32))


def _aligned(values: np.ndarray, kind: type) -> np.ndarray:
    flat: np.ndarray = np.asarray(values, kind).ravel()
    raw = np.empty(flat.nbytes + ALIGNMENT, np.uint8)
    first = -raw.ctypes.data % ALIGNMENT
    aligned: np.ndarray = raw[first : first + flat.nbytes].view(kind)
    aligned[:] = flat
    return aligned
