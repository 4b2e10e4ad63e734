"""Mitsuba plugins: medium, phase function and integrator ``nrf``, emitter ``ntf``.

Importing this package registers nothing; :func:`register` does. The stock ``mitsuba`` program registers the plugins by
itself through the bridge.
"""

from .plugins.registration import load_scene, register

__all__ = ["load_scene", "register"]
