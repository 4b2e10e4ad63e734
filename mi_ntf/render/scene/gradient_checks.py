"""Checks of the scene parameters that carry gradients; parameters without derivatives are refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from .media import lets_light_through

POWERS = {
    "PointLight": ("intensity",),
    "SpotLight": ("intensity", "texture"),
    "DirectionalEmitter": ("irradiance",),
    "EnvironmentMapEmitter": ("data", "scale"),
    "ConstantBackgroundEmitter": ("radiance",),
    "AreaLight": ("radiance",),
    "Projector": ("irradiance", "scale"),
    "SmoothDiffuse": ("reflectance",),
}
"""Mitsuba's class name → parameters in which radiance is linear."""
PLACES = {"PointLight": ("position",), "SpotLight": ("to_world",), "DirectionalEmitter": ("to_world",)}
"""Mitsuba's class name → parameters that move a light of the table, and its shadows."""


class DiscreteEmitter(Protocol):
    """An emitter whose lights are rows of the light table."""

    @property
    def emitter(self) -> mi.Emitter:
        """The emitter itself."""


def check(scene: mi.Scene, discrete: Sequence[DiscreteEmitter]) -> bool:
    """Return True if a parameter of `scene` carries gradients.

    `discrete`: the emitters in the light table. Raises MiNtfError if derivatives by the parameter are not supported.
    """
    parameters = mi.traverse(scene)
    attached = [key for key, value in parameters if dr.grad_enabled(value)]
    for key in attached:
        if not _supported(parameters, key, discrete):
            raise MiNtfError(
                f"gradients by {key}: not supported; detach it. Supported are what lights emit (intensity, irradiance, "
                "radiance, texture of a spot, data and scale of an envmap), the reflectance of diffuse BSDFs and, of "
                "lights that are not drawn at random, the position of a point and the to_world of a spot or directional"
            )
        place = key.rpartition(".")[2] in ("position", "to_world")
        if place and lets_light_through(scene):
            raise MiNtfError(f"gradients by {key}: not supported beside surfaces that let light through (null, mask, "
                             "thindielectric), whose own slopes would be missing; detach it or take these surfaces out")
    return bool(attached)


def _supported(parameters: mi.SceneParameters, key: str, discrete: Sequence[DiscreteEmitter]) -> bool:
    node, words = parameters.properties[key][2], 1
    while node is not None:
        of_owner, kind = ".".join(key.split(".")[-words:]), node.class_name()
        if of_owner.startswith(POWERS.get(kind, ())):
            return True
        if of_owner in PLACES.get(kind, ()):
            return any(node is d.emitter for d in discrete)
        node, words = parameters.hierarchy[node][0], words + 1
    return False
