"""Dr.Jit's types of one back end. Mitsuba's ``mi.Float`` and friends are these very types."""

import importlib
from types import ModuleType

from ..core.errors import MiNtfError


def module(variant: str) -> ModuleType:
    """The Dr.Jit module (``Float``, ``Texture2f``, …) behind a Mitsuba variant such as ``llvm_ad_rgb``.

    Raises MiNtfError for variants without a JIT compiler, without derivatives, or not linear RGB in single precision.
    """
    backend, *rest = variant.split("_")
    if backend not in ("llvm", "cuda") or rest != ["ad", "rgb"]:
        raise MiNtfError(
            f"variant {variant}: the nrf and ntf plugins need llvm_ad_rgb or cuda_ad_rgb; "
            "add `-m llvm_ad_rgb` to the command line"
        )
    return importlib.import_module(f"drjit.{backend}.ad")
