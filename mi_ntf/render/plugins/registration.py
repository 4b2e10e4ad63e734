"""Registration of the plugins, in every variant that they can run in."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec

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

P = ParamSpec("P")

_classes: dict[str, dict[str, Callable[[mi.Properties], mi.Object]]] = {}
_watching = False


def register() -> None:
    """Register the plugins for the current variant and for every variant that is set later. May be called again.

    ``mi.render`` raises the plugins' own errors from then on (:mod:`mi_ntf.render.plugins.render_errors`). Dr.Jit gets
    a second thread if it has one only (:data:`mi_ntf.core.variants.LEAST_THREADS`).

    Raises
    ------
    MiNtfError
        If no variant is set, or one in which the plugins cannot run (scalar, spectral).
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


def load_scene(path: Path, parameters: dict[str, str], environment: Environment | None = None) -> "mi.Scene":
    """Load a scene whose integrator is ``nrf``.

    Parameters
    ----------
    path
        The XML file.
    parameters
        Values of the scene's $names.
    environment
        Environment map in place of the scene's own.

    Returns
    -------
    mi.Scene
        In the current variant; if none is set, in the first of ``VARIANTS`` that this machine can run.

    Raises
    ------
    MiNtfError
        If the scene has another integrator, or the environment does not fit.
    """
    if mi.variant() is None:
        mi.set_variant(*VARIANTS)
    register()
    scene = scene_file.load(path, parameters, environment)
    integrator = scene.integrator()
    if not hasattr(integrator, "context"):
        raise MiNtfError(f'{path}: its integrator is {integrator.class_name()}, expected <integrator type="nrf">')
    return scene


def _with_types(parse_dict: Callable[P, "mi.parser.ParserState"]) -> Callable[P, "mi.parser.ParserState"]:
    """Wrap `mi.parser.parse_dict` so that each ``nrf`` has the type medium or integrator.

    Mitsuba has one type for a name and leaves that of ``nrf`` open, but `mi.parser.write_file` refuses nodes without a
    type.
    """

    @functools.wraps(parse_dict)
    def parse(*args: P.args, **kwargs: P.kwargs) -> "mi.parser.ParserState":
        state = parse_dict(*args, **kwargs)
        for node in state.nodes:
            if node.type == mi.ObjectType.Unknown and node.props.plugin_name() == "nrf":
                node.type = mi.ObjectType.Medium if is_medium(node.props) else mi.ObjectType.Integrator
        return state

    return parse


def _on_variant(_old: str, new: str) -> None:
    """Register the plugins for the new variant if they can run in it."""
    if new in VARIANTS:
        register()
