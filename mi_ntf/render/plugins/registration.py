"""Makes the plugins known to Mitsuba, in every variant that they can run in."""

import functools
from pathlib import Path

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...core.variants import VARIANTS, enough_threads
from ...infer.backend import module
from ..scene import scene_file
from ..scene.environment_option import Environment
from . import render_errors
from .emitter import emitter_class
from .integrator import integrator_class
from .medium import medium_class
from .phase import phase_class
from .properties import is_medium

_classes: dict[str, dict] = {}
_watching = False


def register() -> None:
    """Make the plugins known to the current variant, and to every variant that is set later, and let ``mi.render`` tell
    their errors (:mod:`mi_ntf.render.plugins.render_errors`). May be called again.
    Dr.Jit gets a second thread where it has one (:data:`mi_ntf.core.variants.LEAST_THREADS`).

    Raises MiNtfError in a variant that they cannot run in (none set, scalar, spectral, …).
    """
    global _watching
    variant = mi.variant() or "(none set)"
    module(variant)
    enough_threads(dr)
    if variant not in _classes:
        # Kept alive for good: Mitsuba may still call a constructor after another one took its name.
        medium, integrator = medium_class(phase_class()), integrator_class()
        _classes[variant] = {
            "nrf": lambda props: (medium if is_medium(props) else integrator)(props),
            "emitter": emitter_class(),
        }
    classes = _classes[variant]
    mi.register_integrator("nrf", classes["nrf"])
    mi.register_emitter("ntf", classes["emitter"])
    if not _watching:
        _watching = True
        render_errors.show()
        mi.parser.parse_dict = _with_types(mi.parser.parse_dict)
        mi.detail.add_variant_callback(_on_variant)


def load_scene(path: Path, parameters: dict[str, str], environment: Environment | None = None):
    """The scene of an XML file, `parameters` for its $names, whose integrator is ``nrf``; where no variant is set, in
    the first of `VARIANTS` that this machine can run. `environment` is laid over the scene's own. Raises MiNtfError if
    the integrator is another, or the environment does not fit."""
    if mi.variant() is None:
        mi.set_variant(*VARIANTS)
    register()
    scene = scene_file.load(path, parameters, environment)
    integrator = scene.integrator()
    if not hasattr(integrator, "context"):
        raise MiNtfError(f'{path}: its integrator is {integrator.class_name()}, expected <integrator type="nrf">')
    return scene


def _with_types(parse_dict):
    """Wrap `mi.parser.parse_dict`: each ``nrf`` gets the type medium or integrator. Mitsuba has one type for a name and
    leaves that of ``nrf`` open, and `mi.parser.write_file` refuses nodes without a type."""

    @functools.wraps(parse_dict)
    def parse(*args, **kwargs):
        state = parse_dict(*args, **kwargs)
        for node in state.nodes:
            if node.type == mi.ObjectType.Unknown and node.props.plugin_name() == "nrf":
                node.type = mi.ObjectType.Medium if is_medium(node.props) else mi.ObjectType.Integrator
        return state

    return parse


def _on_variant(_old: str, new: str) -> None:
    """Registrations hold for one variant: repeat them for the new one, where the plugins can run in it."""
    if new in VARIANTS:
        register()
