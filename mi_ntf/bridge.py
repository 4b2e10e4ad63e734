"""Python side of the bridge in `plugins/`: registers plugins when Mitsuba asks for them by name.

The C++ side calls `serve(name, variant)` whenever Mitsuba instantiates one of `PLUGIN_NAMES`
through the native entry. Registration replaces that entry, for this name and variant alone.
"""

import threading
import traceback
from typing import Any

import mitsuba as mi

from mi_ntf.core import errors
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS

OWN_PLUGINS = ("nrf", "ntf")
"""Plugins of this package; `nrf` is medium, phase function and integrator."""

STOCK_INTEGRATORS = {
    "prb": "PRBIntegrator",
    "prb_basic": "BasicPRBIntegrator",
    "prbvolpath": "PRBVolpathIntegrator",
    "direct_projective": "DirectProjectiveIntegrator",
    "prb_projective": "PathProjectiveIntegrator",
    "volprim_rf_basic": "BasicVolumetricPrimitiveRadianceFieldIntegrator",
}
"""Mitsuba's own Python integrators: plugin name (also the module's name) to class."""

PLUGIN_NAMES = (*OWN_PLUGINS, *STOCK_INTEGRATORS)

_lock = threading.Lock()
# Mitsuba drops its reference to a constructor when a name is registered again, perhaps while
# another thread is about to call it. Each is therefore made once and kept.
_constructors: dict[tuple[str, str], Any] = {}


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
    """Make `variant` current and register plugin `name` (one of `PLUGIN_NAMES`) for it.

    May be called from several threads, and again after the registration was overwritten.
    Raises MiNtfError for a variant that the plugin cannot run in.
    """
    check_variant(name, variant)
    with _lock:
        mi.set_variant(variant)
        if name in OWN_PLUGINS:
            from mi_ntf.render import register as register_own_plugins

            register_own_plugins()
        else:
            mi.register_integrator(name, _stock_constructor(name, variant))


def register_all(variant: str) -> None:
    """Make `variant` current and register every plugin that can run in it (for use from Python)."""
    for name in PLUGIN_NAMES:
        # Mitsuba may load the native entry of a name on first mention, and thereby overwrite
        # what Python has registered: mention it before.
        mi.PluginManager.instance().plugin_type(name)
        try:
            register(name, variant)
        except MiNtfError:
            continue


def check_variant(name: str, variant: str) -> None:
    """Raise MiNtfError, with the remedy, unless plugin `name` can run in `variant`."""
    if name in OWN_PLUGINS:
        fits, need = variant in VARIANTS, " and ".join(VARIANTS)
    else:
        fits, need = not variant.startswith("scalar_"), "the vectorised variants (llvm_*, cuda_*)"
    if not fits:
        raise MiNtfError(f'plugin "{name}" works in {need}, not in "{variant}": run `mitsuba -m llvm_ad_rgb …`')


def _stock_constructor(name: str, variant: str) -> Any:
    """Mitsuba's integrator class `name` for the current variant, able to render without developing.

    The stock program calls `render(develop=False)` and lets the film write the file, which
    `ADIntegrator.render` refuses although the film holds all data by then.
    """
    key = (name, variant)
    if key not in _constructors:
        stock = getattr(getattr(mi.ad.integrators, name), STOCK_INTEGRATORS[name])

        def render(
            self: Any,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            image = stock.render(self, scene, sensor, seed, spp, True, evaluate)
            return image if develop else mi.TensorXf()

        _constructors[key] = type(stock.__name__, (stock,), {"render": render})
    return _constructors[key]
