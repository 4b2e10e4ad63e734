"""Python side of the bridge in `bridge_source/`: register plugins when Mitsuba asks for them by name.

The C++ side calls `serve(name, variant, version)` whenever Mitsuba instantiates one of `PLUGIN_NAMES`
through the native entry. Registration replaces that entry, for this name and variant alone.
"""

import threading
import traceback

import mitsuba as mi

from mi_ntf.core import errors
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS

PLUGIN_NAMES = ("nrf", "ntf")
"""Names of the plugins of this package; `nrf` is medium, phase function and integrator.

No name of a plugin of Mitsuba may be added: the bridge's file would replace it in every program that uses this
environment.
"""

_lock = threading.Lock()
_started: set[str] = set()
"""Variants in which :func:`start` has registered the plugins."""


def serve(name: str, variant: str, built_for: str = "another version of mi_ntf") -> str:
    """Call `register`; return '' or the text of the fault, which C++ hands on to the user.

    A fault is described by one sentence, or by its traceback if MI_NTF_DEBUG=1 is set. The bridge was compiled for
    `built_for`, such as "mitsuba 3.9.1".
    """
    try:
        if built_for != f"mitsuba {mi.__version__}":
            raise MiNtfError(f"the bridge was built for {built_for}, installed is mitsuba {mi.__version__}: run "
                             "`mi-ntf bridge`")
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


def start(variant: str = "") -> None:
    """Set `variant`, or for "" the first that this machine can run if none is set, and register the plugins in it.

    Raises MiNtfError for a variant that is unknown or that this machine cannot run.
    """
    if variant and variant not in mi.variants():
        raise MiNtfError(f"unknown variant {variant!r}; this Mitsuba has {', '.join(mi.variants())}")
    if mi.variant() is None or (variant and mi.variant() != variant):
        try:
            mi.set_variant(*([variant] if variant else VARIANTS))
        except ImportError as error:
            raise MiNtfError(f"this machine cannot run {variant or 'any of ' + ', '.join(VARIANTS)}: `mi-ntf doctor` "
                             f"names the remedy ({error})") from error
    if mi.variant() not in _started:
        _started.add(str(mi.variant()))
        register_all(str(mi.variant()))


def register_all(variant: str) -> None:
    """Make `variant` current and register every plugin if they can run in it (for use from Python)."""
    for name in PLUGIN_NAMES:
        # Mitsuba may load the native entry of a name when the name is used first, which overwrites the registration
        # from Python. Use it before registering.
        mi.PluginManager.instance().plugin_type(name)
    if variant in VARIANTS:
        register(PLUGIN_NAMES[0], variant)


def check_variant(name: str, variant: str) -> None:
    """Raise MiNtfError, with the remedy, unless plugin `name` can run in `variant`."""
    if variant not in VARIANTS:
        raise MiNtfError(f'plugin "{name}" works in {" and ".join(VARIANTS)}, not in "{variant}": run '
                         "`mitsuba -m llvm_ad_rgb …`")
