"""Registration of the plugins by Mitsuba 3.10 and newer.

The entry point group ``mitsuba`` names this module. Mitsuba imports it when the first variant is set, and reloads it
after every change of the variant. Older versions do not look for entry points: there the bridge serves the stock
program, and Python programs call :func:`mi_ntf.register`.

Variants in which the plugins cannot run are left alone, since Mitsuba reports every exception of this module, whatever
scene is rendered. Source: Mitsuba 3, "Distributing Python plugins" in its documentation, and ``load_plugins`` of its
module ``detail``.
"""

import mitsuba as mi

from mi_ntf.core.variants import VARIANTS

if mi.variant() in VARIANTS:
    from mi_ntf.render import register

    register()
