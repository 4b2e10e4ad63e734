"""Relight captured neural reflectance fields in Mitsuba 3 with a learned ray transmittance.

    import mitsuba as mi
    import mi_ntf

    mi.set_variant("llvm_ad_rgb")
    mi_ntf.register()                                     # the plugins `nrf` and `ntf`
    field = mi_ntf.Field.load("scenes/statue/field.safetensors")
    image = mi_ntf.relight(field, {"type": "point", "position": [1.5, 2.6, 2.7]})

Importing this package loads neither Mitsuba nor PyTorch: its names are imported when they are first used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .field import Field, Reflectance, clear_caches, relight
    from .render import load_scene, register

__version__ = "0.2.0"
__all__ = ["Field", "Reflectance", "clear_caches", "load_scene", "register", "relight"]

_MODULES = {"Field": "field", "Reflectance": "field", "clear_caches": "field", "relight": "field",
            "load_scene": "render", "register": "render"}
"""Module of each public name."""


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    import importlib

    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
