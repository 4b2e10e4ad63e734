"""Dr.Jit's types of one back end. Mitsuba's ``mi.Float`` and friends are these very types."""

import importlib
from types import ModuleType

import numpy as np

from ..core.errors import MiNtfError
from ..core.variants import VARIANTS
from .types import Float, UInt32


def module(variant: str) -> ModuleType:
    """Return the Dr.Jit module (``Float``, ``Texture2f``, …) behind a Mitsuba variant such as ``llvm_ad_rgb``.

    Raises MiNtfError for variants without a JIT compiler, without derivatives, or not linear RGB in single precision.
    """
    if variant not in VARIANTS:
        raise MiNtfError(
            f"variant {variant}: the nrf and ntf plugins need llvm_ad_rgb or cuda_ad_rgb; "
            "add `-m llvm_ad_rgb` to the command line"
        )
    return importlib.import_module(f"drjit.{variant.partition('_')[0]}.ad")


def module_of(array: type) -> ModuleType:
    """Return the Dr.Jit module of an array type such as ``mi.Float``."""
    return importlib.import_module(array.__module__)


ALIGNMENT = 64
"""Alignment of Dr.Jit's own arrays, bytes."""


def floats(values: np.ndarray, dj: ModuleType) -> Float:
    """Return `values`, raveled, as a ``Float`` of the module `dj`.

    Dr.Jit uses NumPy's memory in place on a processor, and compiles a kernel anew if the alignment of its inputs
    changes. NumPy's alignment is a matter of chance, so the values are copied to aligned memory.
    """
    return dj.Float(_aligned(values, np.float32))


def words(values: np.ndarray, dj: ModuleType) -> UInt32:
    """Return `values`, raveled, as a ``UInt32`` of the module `dj`; see :func:`floats`."""
    return dj.UInt32(_aligned(values, np.uint32))


def _aligned(values: np.ndarray, dtype: type) -> np.ndarray:
    flat: np.ndarray = np.asarray(values, dtype).ravel()
    raw = np.empty(flat.nbytes + ALIGNMENT, np.uint8)
    first = -raw.ctypes.data % ALIGNMENT
    aligned: np.ndarray = raw[first : first + flat.nbytes].view(dtype)
    aligned[:] = flat
    return aligned
