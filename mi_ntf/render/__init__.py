"""Mitsuba plugins: medium, phase function and integrator ``nrf``, emitter ``ntf``. Importing this package registers
nothing.

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import mi_ntf.render
    mi_ntf.render.register()

The stock ``mitsuba`` program does this by itself through the bridge.
"""

from .plugins.registration import load_scene, register

__all__ = ["load_scene", "register"]
