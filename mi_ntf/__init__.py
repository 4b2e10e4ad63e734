"""Relight captured neural reflectance fields in Mitsuba 3 with a learned ray transmittance.

Importing this package loads neither Mitsuba nor PyTorch. `mi_ntf.render.register()` makes the
plugins `nrf` and `ntf` known to Mitsuba; its stock program finds them by itself.
"""

__version__ = "0.1.0"
