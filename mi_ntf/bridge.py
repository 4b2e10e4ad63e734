"""Python side of the bridge in `plugins/`: registers plugins when Mitsuba asks for them by name.

The C++ side calls `serve(name, variant)` whenever Mitsuba instantiates one of `PLUGIN_NAMES`
through the native entry. Registration replaces that entry, for this name and variant alone.
"""

import threading
import traceback

import mitsuba as mi

from mi_ntf.core import errors
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS

PLUGIN_NAMES = ("nrf", "ntf")
"""Plugins of this package; `nrf` is medium, phase function and integrator. None has the name of a plugin of Mitsuba's
own: the bridge's file would take its place in every program that imports mitsuba from this environment."""

_lock = threading.Lock()


def serve(name: str, variant: str) -> str:
    """Call `register`; return '' or the text of the fault, which C++ hands on to the user.

    A fault comes as one sentence, or with its traceback where MI_NTF_DEBUG=1 asks for it.
    """
    try:
        register(name, variant)
    except BaseException as error:
        return traceback.format_exc() if errors.debug() else errors.sentence(error)
    return ""


def register(name: str, variant: str) -> None:
    """Make `variant` current and register the plugins for it; Mitsuba has asked for `name`, one of `PLUGIN_NAMES`.

    May be called from several threads, and again after the registration was overwritten.
    Raises MiNtfError for a variant that the plugins cannot run in.
    """
    check_variant(name, variant)
    with _lock:
        mi.set_variant(variant)
        from mi_ntf.render import register as register_plugins

        register_plugins()


def register_all(variant: str) -> None:
    """Make `variant` current and register every plugin if they can run in it (for use from Python)."""
    for name in PLUGIN_NAMES:
        # Mitsuba may load the native entry of a name on first mention, and thereby overwrite
        # what Python has registered: mention it before.
        mi.PluginManager.instance().plugin_type(name)
    if variant in VARIANTS:
        register(PLUGIN_NAMES[0], variant)


def check_variant(name: str, variant: str) -> None:
    """Raise MiNtfError, with the remedy, unless plugin `name` can run in `variant`."""
    if variant not in VARIANTS:
        raise MiNtfError(f'plugin "{name}" works in {" and ".join(VARIANTS)}, not in "{variant}": run '
                         "`mitsuba -m llvm_ad_rgb …`")
