"""What the entry point group ``mitsuba`` names: Mitsuba 3.10 and newer import this module when the first variant is set
and reload it after every change of variant; importing it registers the plugins.

Older versions do not look for entry points; there the bridge serves the stock program, and
:func:`mi_ntf.render.register` Python. Variants in which the plugins cannot run are left alone, since Mitsuba
announces every exception of a plugin's module, whatever scene is rendered.

Source: Mitsuba 3, "Distributing Python plugins" in its documentation, and ``load_plugins`` of its ``detail`` module.
"""

import mitsuba as mi

from mi_ntf.core.variants import VARIANTS

if mi.variant() in VARIANTS:
    from mi_ntf.render import register

    register()
